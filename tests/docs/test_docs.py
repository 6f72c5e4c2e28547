"""The code in README and docs runs, at a size that tests can afford."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree
import zlib
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from places import ROOT

import sb3_dreamer_urlb
from sb3_dreamer_urlb import dreamer_v2, envs, hub, planning
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.drq_v2.presets import PRESETS as DRQ_PRESETS
from sb3_dreamer_urlb.envs import supervisor
from sb3_dreamer_urlb.intrinsic import registry

OUTSIDE = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "examples/quickstart.ipynb")
]
PAGES = [*OUTSIDE, *sorted((ROOT / "docs").rglob("*.md"))]
HOWTO = sorted((ROOT / "docs" / "howto").glob("*.md"))
TASK = 'gymnasium.make("urlb/walker-run-v0")'
# What makes an example small: numbers of frames and steps.
SMALL = {
    "2_000_000": "480",
    "2000000": "480",
    "1_060_000": "400",
    "1_050_000": "360",
    "500_000": "240",
    "50_000": "120",
    "20_000": "480",
    "10_000": "240",
    "5_000": "120",
    "1_000": "120",
    "episodes=10": "episodes=1",
}


def code_blocks(page: str | Path) -> list[str]:
    """The Python blocks of a page, in their order."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


@pytest.fixture
def small_world(monkeypatch, tmp_path):
    """A cheap walker for the benchmark's tasks, the smallest networks, an empty folder."""
    monkeypatch.chdir(tmp_path)
    for presets in (PRESETS, DRQ_PRESETS):
        for name in presets:
            monkeypatch.setitem(presets, name, presets["tiny"])
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    asked, really_make = [], gymnasium.make

    def make(name, **kwargs):
        asked.append(name)
        if not re.fullmatch(r"urlb/(walker|quadruped|jaco)-\w+-v0", name):
            return really_make(name, **kwargs)
        return CounterEnv(60, action_space=spaces.Box(-1, 1, (6,), np.float32), domain="walker", action_repeat=2)

    monkeypatch.setattr(gymnasium, "make", make)
    return asked


def run(block: str, names: dict) -> dict:
    """Execute a block at small size."""
    for large, small in SMALL.items():
        block = block.replace(large, small)
    assert (left := re.search(r"\d_\d{3}", block)) is None, f"{left[0]} is not made small"
    exec(compile(block, "example", "exec"), names)
    return names


def test_readme(small_world, tmp_path, capsys, monkeypatch):
    [block] = code_blocks("README.md")
    assert len([line for line in block.splitlines() if line]) <= 12
    names = run(block, {})
    assert small_world == ["urlb/walker-stand-v0", "urlb/walker-run-v0"]
    assert names["model"].phase == "finetuning" and names["model"]._planner_is_on()
    assert (tmp_path / "walker-run.zip").exists() and re.search(r"\(.*30\.0.*\)", capsys.readouterr().out)


def test_a_run_that_goes_on(small_world, tmp_path):
    block, *_ = code_blocks("docs/reliability.md")
    model = run(block, {})["model"]
    assert model.phase == "finetuning" and model.num_timesteps >= 360
    again = run(block.replace("1_050_000", "400"), {})["model"]
    assert again is not model and again.num_timesteps >= 400 and again.phase_timesteps > model.phase_timesteps


def test_guards_and_a_replay_on_disk(small_world, tmp_path, monkeypatch):
    _, guards, disk = code_blocks("docs/reliability.md")
    asked = []
    monkeypatch.setattr(supervisor, "make_vec_env", lambda *args, **kwargs: asked.append((args, kwargs)))
    names = run(guards.replace("env = make_supervised", "other = make_supervised"), {"gymnasium": gymnasium})
    assert asked == [(("urlb/walker-run-v0", 4), {"vec_env_cls": envs.SupervisedVecEnv})]
    assert isinstance(names["env"], envs.FaultGuard)
    model = run(disk, {"DreamerV2": dreamer_v2.DreamerV2, "env": names["env"]})["model"].learn(80)
    assert model.replay_buffer.can_sample() and (tmp_path / "runs" / "walker-replay" / "finetuning" / "data.mdb").exists()


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
def test_howto(small_world, tmp_path, page, monkeypatch):
    blocks = [block for block in code_blocks(page) if "package_to_hub" not in block]  # test_sharing
    assert blocks
    names = {"__name__": "howto"}
    monkeypatch.setitem(sys.modules, "howto", ModuleType("howto"))  # dataclasses look their module up
    for block in blocks:
        run(block, names)
    if page.stem in AFTERWARDS:
        AFTERWARDS[page.stem](names, tmp_path)


def after_environment(names, folder):
    assert names["model"].num_timesteps == 240 and names["model"]._n_updates > 0
    assert names["env"].unwrapped.domain == "cheetah"


def after_finetune(names, folder):
    assert all((folder / f"walker-{task}.zip").exists() for task in ("walk", "run", "flip"))
    assert (folder / "snapshots" / "snapshot_240.zip").exists()
    assert names["model"].phase == "finetuning" and names["model"]._n_updates > 0


def after_intrinsic_reward(names, folder):
    model = dreamer_v2.DreamerV2.load("own")
    assert isinstance(model.policy.agent.intrinsic, names["EmbeddingError"]) and model.policy.agent.intrinsic.gain == 2.0
    fresh = dreamer_v2.DreamerV2("CnnPolicy", names["env"], intrinsic_reward="embedding_error", seed=model.seed)
    weight = [m.policy.agent.intrinsic.error.out.weight for m in (model, fresh)]
    assert model.phase_updates > 0 and not weight[0].equal(weight[1])
    assert "intrinsic_reward" in names["simple"]._metrics.sums


def after_evaluate(names, folder):
    # CounterEnv's 60 steps, whoever acts.
    assert names["mean"] == names["total"] == names["returns"][0] == names["random_returns"][0] == 30
    assert names["score"] == pytest.approx(30 / 909)
    assert len(names["truth"]) == 50 and (folder / "open_loop.gif").exists() and (folder / "best").exists()
    assert names["actor"].planner is None and names["model"].phase == "finetuning"


def after_resume(names, folder):
    assert (folder / "runs" / "walker" / "snapshot.zip").exists()
    assert names["model"].num_timesteps == 240


def after_drq_v2(names, folder):
    assert names["model"].phase == "finetuning" and names["model"]._n_updates > 0 and names["done"]
    assert (folder / "pretrained.zip").exists() and names["own"]._n_updates > 0
    assert names["state"][0].shape[:2] == (1, 3)


def after_share(names, folder):
    assert (folder / "walker.zip").exists() and names["model"].learning_rate == 3e-4
    assert names["action"].shape == (6,)


AFTERWARDS = {name.removeprefix("after_"): check for name, check in list(globals().items()) if name.startswith("after_")}


def test_cartpole(monkeypatch):
    monkeypatch.setitem(PRESETS, "vector", PRESETS["tiny"])
    [block] = code_blocks("docs/sb3.md")
    model = run(block.replace("20_000", "200"), {})["model"]
    assert model.num_timesteps == 200 and model._n_updates > 0 and model.discount_head


def test_memory_of_a_recurrent_agent(small_world):
    [block] = code_blocks("docs/concepts.md")
    assert run(block, {})["state"] is not None


def test_evaluations_on_the_way(small_world, tmp_path):
    [block] = code_blocks("docs/evaluation.md")
    model = run(block.replace('planner="both"', 'planner="both", n_eval_episodes=1'), {})["model"]
    assert model.phase == "finetuning"
    assert (tmp_path / "rows.csv").exists() and (tmp_path / "logs" / "evaluations.npz").exists()


def test_rewards_that_are_learnt_while_exploring(monkeypatch):
    for name in PRESETS:
        monkeypatch.setitem(PRESETS, name, PRESETS["tiny"])
    names = {}
    for block in code_blocks("docs/analysis.md"):
        names = run(block.replace("1_000_000", "20").replace("50_000", "20"), names)
        assert names["model"].phase == "finetuning"


def test_perturbed_tasks():
    [block] = code_blocks("docs/tasks.md")
    assert isinstance(run(block, {})["env"], envs.PerturbationWrapper)


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
def test_a_howto_opens_with_what_takes_seconds(page):
    """Before anything else: how the whole looks, at the size of tests."""
    text = page.read_text()
    assert re.findall(r"^## (.*)$", text, re.MULTILINE)[0] == "In 20 seconds", page.name
    block = code_blocks(page)[0]
    assert 'preset="tiny"' in block
    assert max(int(number) for number in re.findall(r"(?:learn\(|steps=)\[?(\d+)", block) or ["0"]) <= 300


def test_code_fits_its_column():
    """What a page of the site has room for on a desk."""
    for page in (page for page in PAGES if page.suffix == ".md"):
        for block in re.findall(r"```\w+\n(.*?)```", page.read_text(), re.DOTALL):
            for line in block.splitlines():
                assert len(line) <= 110, f"{page.name}: {line}"


def test_formulas_are_set():
    """As formulas between $$, which site and GitHub set; z_t in a sentence stays as it is."""
    for page in (page for page in PAGES if page.suffix == ".md"):
        text = re.sub(r"```.*?```|\$\$.*?\$\$|`[^`\n]*`|\]\([^)]*\)", "", page.read_text(), flags=re.DOTALL)
        assert not re.findall(r"(?<![\w/.])[^\W\d_]_(?:\w\b|\{).*", text), page.name


def test_pages_for_readers_stay_short():
    for page, lines in (("performance", 150), ("results", 150)):
        assert len((ROOT / "docs" / f"{page}.md").read_text().splitlines()) <= lines


def test_the_method_is_drawn_by_its_script():
    drawn = runpy.run_path(str(ROOT / "scripts" / "draw_method.py"))["draw"]()
    assert (ROOT / "docs" / "images" / "method.svg").read_text() == drawn
    xml.etree.ElementTree.fromstring(drawn)


def test_every_local_link_leads_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_site(tmp_path):
    """The documentation as ``make docs`` builds it: a page outside the navigation, a broken link or anchor fails."""
    pytest.importorskip("mkdocstrings", reason="needs the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path]
    made = subprocess.run(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert made.returncode == 0 and "WARNING" not in made.stderr, made.stderr
    # One test: building takes seconds.
    every_public_name_has_its_place(tmp_path)
    docstrings_look_as_they_are_meant(tmp_path)
    pages_and_code_come_from_outside_of_docs(tmp_path)
    pages_are_finished(tmp_path)
    signatures_and_members_are_a_readers(tmp_path)


def every_public_name_has_its_place(site):
    # Sphinx's inventory: four lines, then compressed ones, each beginning with a name.
    inventory = zlib.decompress((site / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode()
    documented = {line.split(" ")[0] for line in inventory.splitlines()}
    for module in (sb3_dreamer_urlb, envs, planning, hub):
        assert not {f"{module.__name__}.{name}" for name in module.__all__} - documented
    methods = ("learn", "predict", "save", "load", "resume", "fine_tune")
    assert not {f"sb3_dreamer_urlb.DreamerV2.{name}" for name in methods} - documented


def docstrings_look_as_they_are_meant(site):
    pages = {page.parent.name: page.read_text() for page in (site / "api").rglob("*.html")}
    for name, page in pages.items():
        shown = re.sub(r"<details.*?</details>", "", page, flags=re.DOTALL)  # source code
        assert not re.findall(r":(?:param|raises|return|class|meth|func)\b", shown), name
    assert "#sb3_dreamer_urlb.PhaseSwitchCallback" in pages["algorithm"]  # :class: became a link
    assert "Environment frames seen in the phase" in pages["algorithm"]  # a #: comment became a description


def pages_and_code_come_from_outside_of_docs(site):
    start = (site / "index.html").read_text()
    assert 'href="concepts/"' in start and 'src="images/evidence.png"' in start
    code = (site / "source/sb3_dreamer_urlb/intrinsic/lbs.py/index.html").read_text()
    assert "class LBS" in re.sub(r"<[^>]*>", "", code)
    notebook = (site / "quickstart/index.html").read_text()
    assert "PRETRAIN_FRAMES" in notebook and notebook.count('src="data:image/') == 4 and "random actions" in notebook


def without_sources(page: str) -> str:
    """A page without the folded source code."""
    return re.sub(r"<details class=\"mkdoc.*?</details>", "", page, flags=re.DOTALL)


def signatures_and_members_are_a_readers(site):
    """Defaults are values, not names of constants; what parts of the package ask of each other is not on the pages."""
    for page in (site / "api").rglob("*.html"):
        shown = re.sub(r"<[^>]*>", "", without_sources(page.read_text()))
        assert not re.findall(r"\w+: str = [\w.]*[A-Z_]{3,},", shown), page
    algorithm = (site / "api/algorithm/index.html").read_text()
    assert 'id="sb3_dreamer_urlb.DreamerV2.fine_tune"' in algorithm
    for name in ("adams", "take_over_changes", "go_on_where_left", "prepare_fine_tuning_env"):
        assert f'id="sb3_dreamer_urlb.DreamerV2.{name}"' not in algorithm
    for page, text in {
        "planners": "the fields of the configuration that the name settles",  # an attribute's comment
        "environments": "Any subset of the suite's perturbations",
        "intrinsic_rewards": "In imagination there is no observation, so a head learns to predict the surprise",
    }.items():
        assert text in (site / f"api/{page}/index.html").read_text(), page


def pages_are_finished(site):
    algorithm = (site / "algorithm/index.html").read_text()
    assert algorithm.count("<math") >= 3 and "arithmatex" not in algorithm and "$$" not in algorithm
    for page in site.rglob("*.html"):
        formulas = re.findall(r"<math.*?</math>", page.read_text(), re.DOTALL)
        assert not [one for one in formulas if "\\" in one], f"{page}: a command of TeX that was not understood"
        assert not re.search(r"<th[^>]*>\s*</th>\s*</tr>\s*</thead>\s*<tbody>\s*</tbody>", page.read_text()), page
    empty = re.compile(r"<thead>\s*<tr>(\s*<th[^>]*>\s*</th>)+\s*</tr>\s*</thead>")
    assert not [page for page in site.rglob("*.html") if empty.search(page.read_text())]
    api = (site / "api/algorithm/index.html").read_text()
    assert '<details class="signature">' in api and "_init_setup_model" not in without_sources(api)
    zoo = (site / "zoo/index.html").read_text()
    assert '<code class="short">-i</code>' in zoo and "1\u00a0050\u00a0000" in zoo
    assert not [
        block for block in re.findall(r"<pre.*?</pre>", zoo, re.DOTALL) if "\u00a0" in block or "short" in block.split(">")[1]
    ]
    start = (site / "index.html").read_text()
    assert start.count("data-md-color-media") >= 3  # a switch between light and dark
    for address in re.findall(r'(?:src|href)="(https?://[^"]+\.(?:js|css|woff2?))"', start + algorithm):
        raise AssertionError(f"the site would fetch {address}")


def test_logging_and_films(small_world, tmp_path, monkeypatch):
    [block] = code_blocks("docs/logging.md")
    block = block.replace("VideoCallback(video_freq=50_000)", f"VideoCallback({TASK}, video_freq=60)")
    names = run(block.replace("EvalCallback(eval_env", "EvalCallback(eval_env, n_eval_episodes=1"), {})
    assert names["model"].num_timesteps >= 360
    assert {"progress.csv", "progress.json"} <= {path.name for path in (tmp_path / "logs").iterdir()}
    assert "eval/mean_reward" in (tmp_path / "logs" / "progress.json").read_text()


def test_sharing(small_world, tmp_path):
    [block] = [block for block in code_blocks("docs/howto/share.md") if "package_to_hub" in block]
    block = block.replace('"./shared/walker-run",', f'"./shared/walker-run", {TASK}, env_id="urlb/walker-run-v0",')
    names = run(block, {"gymnasium": gymnasium, "DreamerV2": dreamer_v2.DreamerV2})
    assert Path(names["path"]) == Path("shared/walker-run/dreamerv2-urlb-walker-run-v0.zip")
    assert names["model"].phase == "finetuning" and "python train.py" in (tmp_path / "shared/walker-run/README.md").read_text()


def test_one_line_installs_everywhere():
    """No index has the package: whoever wrote its name there would get somebody else's."""
    texts = {path: path.read_text() for path in [*PAGES, *(ROOT / "sb3_dreamer_urlb").rglob("*.py")]}
    lines = [
        (path.name, found) for path, text in texts.items() for found in re.findall(r"pip install [^`\n)]*\[[^`\n)]*", text)
    ]
    ours = [(name, line) for name, line in lines if "gymnasium[" not in line]
    assert len(ours) > 5 and all(re.match(r"pip install '\.\[[\w,{}]+\]'", line) for _, line in ours), ours
