# SPDX-License-Identifier: Apache-2.0
"""Execute the notebooks of examples/ and store their outputs: ``python docs/run_notebooks.py [NAME
...]`` (default: all).

Each runs in a new folder, from which ``../tests`` and ``learning`` are those that it has beside it.
Needs the packages of requirements-dev.txt.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

try:
    import nbformat
    from nbclient import NotebookClient
except ImportError:
    sys.exit("run_notebooks: nbclient is missing; pip install -r requirements-dev.txt")

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
TIMEOUT_S = 600


def executed(path: Path, top: Path) -> Any:
    """Return the notebook with the outputs of an execution in a new folder of ``top``. Raises
    CellExecutionError.
    """
    folder = top / "work"
    folder.mkdir()
    (top / "tests").symlink_to(ROOT / "tests")
    (folder / "learning").symlink_to(EXAMPLES / "learning")
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(folder)}}
    )
    # Cells call ``!chaserdock``: the command of this environment, also where it is not activated.
    path_variable = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    client.execute(env=os.environ | {"PATH": path_variable})
    return without_traces(notebook, folder)


def without_traces(notebook: Any, folder: Path) -> Any:
    """Remove what differs between machines and executions, such as the name of ``folder``, from a
    notebook; return it.
    """
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = {}
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                output.text = output.text.replace(f"{folder}/", "")
    return notebook


def main() -> int:
    known = sorted(path.stem for path in EXAMPLES.glob("*.ipynb"))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    names = parser.parse_args().names or known
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no notebook {unknown[0]}; there are {', '.join(known)}")
    for name in names:
        path = EXAMPLES / f"{name}.ipynb"
        with tempfile.TemporaryDirectory(prefix="chaserdock-notebook-") as top:
            nbformat.write(executed(path, Path(top)), path)
        print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
