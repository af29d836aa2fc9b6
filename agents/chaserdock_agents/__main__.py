"""``python -m chaserdock_agents`` is the ``chaserdock`` program."""

from chaserdock_agents.cli import main

if __name__ == "__main__":
    main()
