"""The verbs of the ``chaserdock`` program, a module a group; ``cli`` puts them together."""
