"""Runs examples/quickstart.ipynb and stores it with its outputs: python scripts/run_notebook.py, or make notebook.

What it shows is what the present code does with the sizes in its first cell of code; about a minute. A digest of the sources
is stored, so that a test sees when a cell was changed and the outputs were not.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat

NOTEBOOK = Path(__file__).parents[1] / "examples" / "quickstart.ipynb"
#: of the notebook's metadata
DIGEST = "sources_sha256"


def digest(notebook: Any) -> str:
    """Of the cells' sources, in their order."""
    return hashlib.sha256("\0".join(cell.source for cell in notebook.cells).encode()).hexdigest()


def executed(notebook: Any, folder: Path) -> Any:
    """The notebook with the outputs that its cells have now, and nothing that depends on when and where.

    :param notebook: of nbformat, changed in place
    :param folder: in which it runs and writes its files
    """
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):  # else in the home folder
        os.environ[name] = str(folder / name)
    nbclient.NotebookClient(notebook, timeout=None, resources={"metadata": {"path": folder}}, record_timing=False).execute()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            # Warnings, whose text names this machine's folders.
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        DIGEST: digest(notebook),
    }
    return notebook


def main() -> None:
    """Run it and write it where it was."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        nbformat.write(executed(notebook, Path(folder)), NOTEBOOK)
    print(f"Wrote {NOTEBOOK}, {NOTEBOOK.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
