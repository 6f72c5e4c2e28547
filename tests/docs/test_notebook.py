"""The notebook runs, at a size that tests can afford, and is committed without outputs."""

from __future__ import annotations

import pytest
from places import ROOT

nbformat = pytest.importorskip("nbformat", reason="needs the extra notebook")
nbclient = pytest.importorskip("nbclient", reason="needs the extra notebook")
pytest.importorskip("ipykernel", reason="needs the extra notebook")

NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"
# Two whole episodes of pre-training, two of fine-tuning.
SIZES = """
TASK, PRESET = "walker-stand", "tiny"
PRETRAIN_FRAMES = FINETUNE_FRAMES = 240
EPISODE_STEPS, EPISODES = 60, 1
"""


@pytest.fixture
def notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def test_it_runs(notebook, tmp_path, monkeypatch):
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):  # else in the home folder
        monkeypatch.setenv(name, str(tmp_path / name))
    [sizes] = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    sizes.source = SIZES
    nbclient.NotebookClient(notebook, timeout=200, resources={"metadata": {"path": tmp_path}}).execute()
    texts = [
        output.get("text", output.get("data", {}).get("text/plain", "")) for cell in notebook.cells for output in outputs(cell)
    ]
    assert "('pretraining', 240)" in texts and "('finetuning', 240)" in texts
    assert any(text.startswith("fine-tuned agent") for text in texts)
    names = {"random.gif", "open_loop.gif", "agent.gif", "learning_curve.png", "pretrained.zip", "finetuned.zip"}
    assert names <= {path.name for path in tmp_path.iterdir()}


def test_it_is_committed_without_outputs(notebook):
    assert not any(outputs(cell) or cell.get("execution_count") for cell in notebook.cells)


def outputs(cell):
    return cell.get("outputs", [])
