"""The notebook runs, at a size that tests can afford, and is stored with the outputs of the sources that it has."""

from __future__ import annotations

import importlib.util

import pytest
from places import ROOT

nbformat = pytest.importorskip("nbformat", reason="needs the extra notebook")
pytest.importorskip("nbclient", reason="needs the extra notebook")
pytest.importorskip("ipykernel", reason="needs the extra notebook")

NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"
# One whole episode of each phase, and as many steps as the open-loop film needs.
SIZES = """
TASK, PRESET = "walker-stand", "tiny"
PRETRAIN_FRAMES = FINETUNE_FRAMES = 48
EPISODE_STEPS, EPISODES = 24, 1
"""


@pytest.fixture
def notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("run_notebook", ROOT / "scripts" / "run_notebook.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_runs(notebook, script, tmp_path, monkeypatch):
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):  # the script sets them; this takes them back
        monkeypatch.setenv(name, str(tmp_path / name))
    [sizes] = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    sizes.source = SIZES
    ran = script.executed(notebook, tmp_path)
    said = texts(ran)
    assert "('pretraining', 48)" in said and "('finetuning', 48)" in said
    assert any(text.startswith("fine-tuned agent") for text in said)
    names = {"random.gif", "open_loop.gif", "agent.gif", "learning_curve.png", "pretrained.zip", "finetuned.zip"}
    assert names <= {path.name for path in tmp_path.iterdir()}


def test_it_is_stored_with_its_outputs(notebook, script):
    """Of these sources, from the first cell to the last; 'make notebook' makes them anew."""
    assert notebook.metadata[script.DIGEST] == script.digest(notebook), "a cell was changed: make notebook"
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    kinds = [kind for output in outputs for kind in output.get("data", ()) if kind.startswith("image/")]
    assert sorted(kinds) == ["image/gif", "image/gif", "image/gif", "image/png"]
    assert any(text.startswith("fine-tuned agent") for text in texts(notebook))
    assert NOTEBOOK.stat().st_size < 3_000_000 and str(ROOT) not in NOTEBOOK.read_text()


def texts(notebook):
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [output.get("text", output.get("data", {}).get("text/plain", "")) for output in outputs]
