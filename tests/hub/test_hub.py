"""Sharing models: for real through folders, and through a stand-in for the Hub's client that checks every call."""

from __future__ import annotations

import inspect
import io
import json
import re
import shutil
import sys
import zipfile
from pathlib import Path

import gymnasium
import huggingface_hub
import imageio.v2
import numpy as np
import pytest
from fake_envs import CounterEnv, UndrawnEnv
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from huggingface_hub.errors import RemoteEntryNotFoundError
from snapshot_files import code_events
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

import sb3_dreamer_urlb
from sb3_dreamer_urlb import DreamerV2, DrQv2, PlannerConfig, SnapshotError, register_intrinsic_reward, register_planner
from sb3_dreamer_urlb.hub import load_from_hub, load_vec_normalize, package_to_hub, push_to_hub, save_vec_normalize
from sb3_dreamer_urlb.hub import package as packaging
from sb3_dreamer_urlb.hub.privacy import without_private_paths
from sb3_dreamer_urlb.hub.repositories import FolderRepository, HubRepository, check_filename, open_repository
from sb3_dreamer_urlb.hub.usage import who_registers
from sb3_dreamer_urlb.intrinsic import registry as methods
from sb3_dreamer_urlb.intrinsic.random_actions import RandomActions
from sb3_dreamer_urlb.planning import DynaMPC
from sb3_dreamer_urlb.planning import registry as planners

ID, VECTORS = "test/Counter-v0", "test/Vectors-v0"
COMMAND = "python -m sb3_dreamer_urlb.zoo train --algo dreamerv2 --env test/Counter-v0 --seed 3"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Counting environments that gymnasium knows by name."""
    kwargs = {"length": 9, "action_repeat": 2, "domain": "walker", "render_mode": None}
    monkeypatch.setitem(gymnasium.registry, ID, EnvSpec(ID, "fake_envs:CounterEnv", kwargs=kwargs))
    kwargs = {"length": 9, "observation_space": spaces.Box(-1, 1, (3,), np.float32), "render_mode": None}
    monkeypatch.setitem(gymnasium.registry, VECTORS, EnvSpec(VECTORS, "fake_envs:CounterEnv", kwargs=kwargs))


@pytest.fixture
def model(tiny_model):
    """Pre-trained for 40 frames, then fine-tuned for 24."""
    model = tiny_model(gymnasium.make(ID), intrinsic_reward="lbs", planner="dyna_mpc", seed=3).learn(20)
    model.fine_tune()
    return model.learn(12)


def card(folder: Path) -> huggingface_hub.ModelCard:
    return huggingface_hub.ModelCard((folder / "README.md").read_text())


# -- a folder --------------------------------------------------------------------------------------------------------------


def test_a_model_goes_into_a_folder_and_comes_back(model, weights, tmp_path):
    folder = tmp_path / "hub" / "walker"
    assert package_to_hub(model, folder, n_eval_episodes=3, command=COMMAND, video_length=7) == str(folder)
    assert {path.name for path in folder.iterdir()} == {
        "dreamerv2-test-Counter-v0.zip", "README.md", "config.json", "results.json", "replay.mp4",
    }  # fmt: skip
    with code_events() as events:
        path = load_from_hub(folder)
    assert events == [] and path == str(folder / "dreamerv2-test-Counter-v0.zip")
    loaded = DreamerV2.load(load_from_hub(f"file://{folder}"), env=gymnasium.make(ID), device="cpu")
    assert weights(loaded.policy) == weights(model.policy) and loaded.phase == "finetuning"
    results = json.loads((folder / "results.json").read_text())
    # The counting environment pays 0, 1, 0.5 in turn, nine times.
    assert (results["mean_reward"], results["std_reward"], results["n_eval_episodes"]) == (4.5, 0.0, 3)
    assert results["is_deterministic"] is True and re.match(r"\d{4}-\d\d-\d\dT", results["eval_datetime"])
    with imageio.v2.get_reader(folder / "replay.mp4") as film:
        assert film.count_frames() == 7 and film.get_meta_data()["size"] == (32, 32)
        assert film.get_meta_data()["codec"] == "h264"


def test_the_card_says_what_a_reader_wants_to_know(model, tmp_path):
    package_to_hub(model, tmp_path, n_eval_episodes=1, command=COMMAND, video_length=0)
    text = card(tmp_path).text
    for stated in (
        "| environment | `test/Counter-v0` |",
        "| domain | walker |",
        "| method of pre-training | `lbs` |",
        "| phase | trained on the task |",
        "| frames | 40 of pre-training, then 24 on the task, 2 frames an agent step |",
        "| planner | `dyna_mpc` |",
        "| seed | 3 |",
        "| return | 4.50 +/- 0.00 (mean and standard deviation of 1 deterministic episode) |",
        f"```sh\n{COMMAND}\n```",
        f"sb3_dreamer_urlb {sb3_dreamer_urlb.__version__}",
        '"policy": "CnnPolicy"',
        '"preset": "tiny"',
    ):
        assert stated in text, stated
    assert "replay.mp4" not in text and "tensorboard_log" not in text
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["method"] == "lbs" and (config["pretrained_frames"], config["frames"]) == (40, 24)


def test_the_cards_metadata_is_what_the_hub_expects(model, tmp_path):
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    data = card(tmp_path).data
    assert (data.library_name, data.pipeline_tag, data.model_name) == (
        "stable-baselines3",
        "reinforcement-learning",
        "DreamerV2",
    )
    assert {"test/Counter-v0", "reinforcement-learning", "stable-baselines3", "walker", "lbs"} <= set(data.tags)
    [result] = data.eval_results
    assert (result.task_type, result.metric_type, result.metric_value, result.dataset_name) == (
        "reinforcement-learning", "mean_reward", "4.50 +/- 0.00", "test/Counter-v0",
    )  # fmt: skip
    assert "model-index:" in (tmp_path / "README.md").read_text()
    assert "The command was not recorded." in card(tmp_path).text


@pytest.mark.parametrize("kind", ["pretraining", "scratch", "old"])
def test_the_cards_of_other_models(tiny_model, tmp_path, kind):
    model = tiny_model(gymnasium.make(ID), intrinsic_reward=None if kind == "scratch" else "rnd", seed=None).learn(20)
    if kind == "old":  # a snapshot from before pretrained_frames was kept
        model.fine_tune()
        model.pretrained_frames = 0
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    text = card(tmp_path).text
    assert "| seed | none |" in text and "| planner | none |" in text
    stated = {
        "pretraining": ["pre-training: the task's reward was not used", "| 40 of pre-training, 2 frames", "model.fine_tune()"],
        "scratch": ["| method of pre-training | none, learnt from scratch |", "| 40 on the task, 2 frames"],
        "old": ["an unknown number of pre-training, then 0 on the task"],
    }
    assert all(line in text for line in stated[kind])


def test_an_agent_without_a_world_model_goes_there_and_its_card_loads_it(weights, tmp_path):
    env = gymnasium.make(ID)
    model = DrQv2("CnnPolicy", env, preset="tiny", intrinsic_reward="disagreement", seed=3, device="cpu").learn(20)
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=3)
    text = card(tmp_path).text
    assert "# DrQv2 in `test/Counter-v0`" in text and "| planner | none |" in text and "world model" not in text
    assert "DreamerV2" not in (tmp_path / "README.md").read_text()
    assert card(tmp_path).data.model_name == "DrQv2" and "drq-v2" in card(tmp_path).data.tags
    path = load_from_hub(tmp_path)
    assert Path(path).name == "drq_v2-test-Counter-v0.zip" and "model = DrQv2.load(" in text
    loaded = DrQv2.load(path, env=env, device="cpu")
    assert weights(loaded.policy) == weights(model.policy) and (tmp_path / "replay.mp4").is_file()


def test_other_algorithms_models_are_refused(tmp_path):
    with pytest.raises(ValueError, match="A model of DreamerV2 or DrQv2 can be shared, got PPO"):
        package_to_hub(PPO("MlpPolicy", "Pendulum-v1", n_steps=8, device="cpu"), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["images", "normalised vectors"])
def test_the_code_in_the_card_runs(tiny_model, weights, tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    if kind == "images":
        model = tiny_model(gymnasium.make(ID), intrinsic_reward="lbs").learn(20)
    else:
        model = tiny_model(VecNormalize(make_vec_env(VECTORS, 2)), "MlpPolicy").learn(40)
    package_to_hub(model, "./shared", n_eval_episodes=1, video_length=0)
    monkeypatch.chdir((tmp_path / "shared").rename(tmp_path / "copied"))  # a colleague's copy
    [code] = re.findall(r"```python\n(.*?)```", card(tmp_path / "copied").text, re.DOTALL)
    assert str(tmp_path) not in card(tmp_path / "copied").text
    before = weights(model.policy)
    names: dict = {}
    exec(code.replace("model.learn(50_000)", "model.learn(8)"), names)
    if kind == "images":
        assert names["model"].phase == "finetuning" and names["model"].pretrained_frames == 40
    else:
        assert weights(names["model"].policy) == before
        assert np.array_equal(names["env"].obs_rms.mean, model.get_vec_normalize_env().obs_rms.mean)


def test_an_environment_of_ones_own(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(8)).learn(8)
    with pytest.raises(
        ValueError, match=r"needs eval_env, .*; and env_id, .*; and the extra file 'notes': there is no /none\."
    ):
        package_to_hub(model, tmp_path, video_length=0, extra_files={"notes": "/none"})
    with pytest.raises(ValueError, match="give env_id"):
        package_to_hub(model, tmp_path, CounterEnv(8), video_length=0)
    package_to_hub(model, tmp_path, CounterEnv(8), n_eval_episodes=1, env_id="my env", model_name="best", video_length=0)
    assert load_from_hub(tmp_path) == str(tmp_path / "best.zip") and "`my env`" in card(tmp_path).text


def test_what_fails_leaves_the_repository_as_it_was(model, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="does not fit the model"):
        package_to_hub(model, tmp_path, CounterEnv(size=20), env_id="x")
    with pytest.raises(ValueError, match="n_eval_episodes must be an integer of at least 1, got 0"):
        package_to_hub(model, tmp_path, n_eval_episodes=0)
    monkeypatch.setattr(packaging.cards, "model_card", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    assert list(tmp_path.iterdir()) == []


def test_without_pictures_there_is_no_film(tiny_model, tmp_path):
    model = tiny_model(gymnasium.make(VECTORS), "MlpPolicy").learn(8)
    blind = CounterEnv(8, observation_space=model.observation_space, render_mode=None)
    with pytest.warns(UserWarning, match=r"no replay\.mp4.*nothing to film"):
        package_to_hub(model, tmp_path, blind, n_eval_episodes=1, env_id=VECTORS)
    undrawn = UndrawnEnv(CounterEnv(8, observation_space=model.observation_space))
    with pytest.warns(UserWarning, match=r"no replay\.mp4.*pygame is not installed"):
        package_to_hub(model, tmp_path, undrawn, n_eval_episodes=1, env_id=VECTORS)
    assert not (tmp_path / "replay.mp4").exists() and (tmp_path / "README.md").exists()


def test_missing_packages_are_told_at_once(model, tmp_path, monkeypatch):
    monkeypatch.setattr(packaging.importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else name)
    with pytest.raises(ImportError, match=r"pip install '\.\[hub\]'"):
        package_to_hub(model, tmp_path)
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"pip install '\.\[hub\]'"):
        load_from_hub("user/name")
    assert load_from_hub(tmp_path).endswith(".zip")  # a folder needs nothing


def test_one_file(model, tmp_path):
    model.save(tmp_path / "snapshot_2000000")
    push_to_hub(tmp_path / "shared", tmp_path / "snapshot_2000000.zip")
    path = load_from_hub(tmp_path / "shared", "snapshot_2000000.zip")
    assert DreamerV2.load(path, device="cpu").phase == "finetuning"
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        load_from_hub(tmp_path / "shared")
    with pytest.raises(FileNotFoundError):
        push_to_hub(tmp_path / "shared", tmp_path / "nothing.zip")


def test_a_folder_that_is_not_there_and_one_without_a_model(tmp_path, monkeypatch):
    """What the code of a card meets in another folder than the card's."""
    for filename in (None, "vec_normalize.json"):
        with pytest.raises(FileNotFoundError, match=f"There is no such folder: '{tmp_path}/nohub'"):
            load_from_hub(tmp_path / "nohub", filename)
        monkeypatch.chdir(tmp_path)
        with pytest.raises(
            FileNotFoundError, match=rf"file in {tmp_path}, which holds no model .*no config\.json\. .*own folder"
        ):
            load_from_hub("./", filename)
    (tmp_path / "config.json").write_text('{"model": "model.zip"}')
    for filename in (None, "model.zip"):
        with pytest.raises(FileNotFoundError, match=f"No such file in the repository {tmp_path}: 'model.zip'"):
            load_from_hub("./", filename)


# -- strangers -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["../secret.zip", "/etc/passwd", "a/../../b", "", "a\\..\\b", "a\nb"])
def test_names_that_lead_out_of_the_repository(tmp_path, name):
    (tmp_path / "config.json").write_text(json.dumps({"model": name}))
    for arguments in ((), (name,)):
        with pytest.raises(ValueError, match="no name of a file"):
            load_from_hub(tmp_path, *arguments)


@pytest.mark.parametrize(
    "config", ["[]", "{}", '{"model": 3}', "nonsense", "[" * 100_000, '{"model": "a"' + " " * (1 << 20) + "}"]
)
def test_a_config_that_says_nothing(tmp_path, config):
    (tmp_path / "config.json").write_text(config)
    with pytest.raises(ValueError):
        load_from_hub(tmp_path)


def test_a_pickled_model_is_refused(tmp_path):
    PPO("MlpPolicy", "Pendulum-v1", n_steps=8, device="cpu").save(tmp_path / "ppo.zip")
    with code_events() as events, pytest.raises(SnapshotError, match="it is a pickle"):
        DreamerV2.load(load_from_hub(tmp_path, "ppo.zip"), device="cpu")
    assert events == []


# -- the Hub, without a network --------------------------------------------------------------------------------------------


class FakeHub:
    """Stands for ``HfApi``: keeps repositories in a folder, and takes only calls that the real one would take."""

    def __init__(self, root: Path):
        self.root, self.calls = root, []

    def __call__(self, **kwargs) -> FakeHub:
        inspect.signature(real_api).bind(**kwargs)
        self.calls.append(("HfApi", kwargs))
        return self

    def __getattr__(self, name):
        signature = inspect.signature(getattr(real_api, name))

        def call(**kwargs):
            signature.bind(self, **kwargs)
            self.calls.append((name, kwargs))
            return getattr(type(self), f"_{name}")(self, **kwargs)

        return call

    def _create_repo(self, repo_id, private, exist_ok):
        (self.root / repo_id).mkdir(parents=True, exist_ok=exist_ok)
        return huggingface_hub.RepoUrl(f"https://huggingface.co/{repo_id}")

    def _upload_folder(self, repo_id, folder_path, commit_message):
        shutil.copytree(folder_path, self.root / repo_id, dirs_exist_ok=True)

    def _hf_hub_download(self, repo_id, filename, revision):
        if not (self.root / repo_id / filename).is_file():
            error = RemoteEntryNotFoundError.__new__(RemoteEntryNotFoundError)
            raise error
        return str(self.root / repo_id / filename)


real_api = huggingface_hub.HfApi


@pytest.fixture
def hub(tmp_path, monkeypatch):
    fake = FakeHub(tmp_path / "the hub")
    monkeypatch.setattr(huggingface_hub, "HfApi", fake)
    return fake


def test_through_the_hub(model, weights, hub):
    url = package_to_hub(
        model, "somebody/walker", n_eval_episodes=1, video_length=0, token="hf_x", private=True, commit_message="Walks"
    )
    assert url == "https://huggingface.co/somebody/walker"
    made, created, uploaded = hub.calls
    assert made == (
        "HfApi",
        {"token": "hf_x", "library_name": "sb3_dreamer_urlb", "library_version": sb3_dreamer_urlb.__version__},
    )
    assert created == ("create_repo", {"repo_id": "somebody/walker", "private": True, "exist_ok": True})
    assert uploaded[0] == "upload_folder" and uploaded[1]["commit_message"] == "Walks"
    assert not Path(uploaded[1]["folder_path"]).exists()  # it was a temporary one
    assert 'load_from_hub("somebody/walker")' in card(hub.root / "somebody/walker").text

    hub.calls.clear()
    loaded = DreamerV2.load(load_from_hub("somebody/walker", revision="v1", token="hf_y"), device="cpu")
    assert weights(loaded.policy) == weights(model.policy)
    assert hub.calls[0][1]["token"] == "hf_y"
    assert [call for call in hub.calls if call[0] != "HfApi"] == [
        ("hf_hub_download", {"repo_id": "somebody/walker", "filename": name, "revision": "v1"})
        for name in ("config.json", "dreamerv2-test-Counter-v0.zip")
    ]
    with pytest.raises(FileNotFoundError, match="somebody/walker"):
        load_from_hub("somebody/walker", "other.zip")


def test_one_file_through_the_hub(model, hub, tmp_path):
    model.save(tmp_path / "best_model")
    assert push_to_hub("somebody/walker", tmp_path / "best_model.zip") == "https://huggingface.co/somebody/walker"
    assert [name for name, _ in hub.calls] == ["HfApi", "create_repo", "upload_folder"]
    assert [path.name for path in (hub.root / "somebody/walker").iterdir()] == ["best_model.zip"]


# -- which repository ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("repo_id", "folder"),
    [
        ("./a", "a"), (".", "."), ("../a/b", "../a/b"), ("/tmp/a", "/tmp/a"), ("file:///tmp/a%20b", "/tmp/a b"),
        ("file://localhost/tmp", "/tmp"), (Path("user/name"), "user/name"), ("~/a", str(Path("~/a").expanduser())),
    ],
)  # fmt: skip
def test_folders(repo_id, folder):
    repository = open_repository(repo_id)
    assert isinstance(repository, FolderRepository) and repository.folder == Path(folder)


def test_a_name_is_the_hubs_even_where_a_folder_is_called_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("user/name").mkdir(parents=True)
    assert isinstance(open_repository("user/name"), HubRepository)


@pytest.mark.parametrize(
    "repo_id", ["name", "a/b/c", "https://huggingface.co/a/b", "file://server/share", "file:x", "", 3, None]
)
def test_what_is_no_repository(repo_id):
    with pytest.raises(ValueError, match=r"repo_id|folder's address"):
        open_repository(repo_id)


def test_folders_have_no_revisions_and_are_no_files(tmp_path):
    with pytest.raises(ValueError, match="no revisions"):
        open_repository(tmp_path, revision="main")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        open_repository(tmp_path / "file")


def test_names_of_files():
    assert check_filename("logs/run..1/events.out") == "logs/run..1/events.out"


# -- statistics of VecNormalize --------------------------------------------------------------------------------------------


def dict_env():
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "b": spaces.Box(-1, 1, (2, 2), np.float32)})
    return make_vec_env(lambda: CounterEnv(6, observation_space=space), 2)


def vector_env():
    return make_vec_env(VECTORS, 2)


@pytest.mark.parametrize("make", [dict_env, vector_env])
def test_statistics_come_back_bit_for_bit(tmp_path, make):
    env = VecNormalize(make(), clip_obs=5.0, gamma=0.9, epsilon=1e-6)
    env.reset()
    for _ in range(20):
        env.step(np.stack([env.action_space.sample() for _ in range(2)]))
    save_vec_normalize(env, tmp_path / "statistics.json")
    with code_events() as events:
        other = load_vec_normalize(tmp_path / "statistics.json", make())
    assert events == [] and not other.training and not other.norm_reward
    assert (other.clip_obs, other.gamma, other.epsilon, other.norm_obs_keys) == (5.0, 0.9, 1e-6, env.norm_obs_keys)
    seen = env.get_original_obs()
    first, second = env.normalize_obs(seen), other.normalize_obs(seen)
    assert (
        all(np.array_equal(first[key], second[key]) for key in first)
        if isinstance(first, dict)
        else np.array_equal(first, second)
    )
    assert (other.ret_rms.mean, other.ret_rms.count) == (env.ret_rms.mean, env.ret_rms.count)
    going_on = load_vec_normalize(tmp_path / "statistics.json", make(), training=True)
    assert going_on.training and going_on.norm_reward


STATISTICS = {
    f"normalization.{name}.{part}": value
    for name, values in {"return": (0, 1, 1), "observation": ([0] * 3, [1] * 3, 1)}.items()
    for part, value in zip(("mean", "var", "count"), values, strict=True)
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"statistics": None}, "no names"),
        ({"statistics": {}}, "had the statistics"),
        ({"statistics": {**STATISTICS, "normalization.observation.mean": [0, 0]}}, "shape"),
        ({"statistics": {**STATISTICS, "normalization.observation.var": [1, 1, -1]}}, "var"),
        ({"statistics": {**STATISTICS, "normalization.observation.var": [1, 1, float("inf")]}}, "Infinity"),
        ({"statistics": {**STATISTICS, "normalization.observation.mean": [0, 0, "x"]}}, "refused"),
        ({"clip_obs": "10"}, "clip_obs"),
        ({"clip_obs": True}, "clip_obs"),
        ({"norm_obs": 1}, "norm_obs"),
        ({"norm_obs_keys": "a"}, "norm_obs_keys"),
        ({"extra": 1}, "other fields"),
    ],
)
def test_damaged_statistics_are_refused(tmp_path, change, message):
    path = tmp_path / "statistics.json"
    save_vec_normalize(VecNormalize(vector_env()), path)
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, **change}))
    with pytest.raises(SnapshotError, match=rf"statistics\.json.*{message}"):
        load_vec_normalize(path, vector_env())
    path.write_bytes(b" " * (9 << 20))
    with pytest.raises(SnapshotError):
        load_vec_normalize(path, vector_env())


def test_statistics_as_stable_baselines3_writes_them_are_refused_with_the_way_to_convert_them(tmp_path):
    old, new = tmp_path / "vecnormalize.pkl", tmp_path / "new.json"
    before = VecNormalize(vector_env())
    before.reset()
    before.save(str(old))
    with pytest.raises(SnapshotError, match=r"it is a pickle.*could run any code.*save_vec_normalize"):
        load_vec_normalize(old, vector_env())
    save_vec_normalize(VecNormalize.load(str(old), vector_env()), new)
    assert load_vec_normalize(new, vector_env()).obs_rms.count == before.obs_rms.count
    old.write_bytes(b"\xff\xfe")
    with pytest.raises(SnapshotError, match="it is no text, where JSON was expected"):
        load_vec_normalize(old, vector_env())


def test_a_film_of_odd_size(tmp_path):
    packaging.write_mp4([np.zeros((33, 21, 3), np.uint8)] * 3, tmp_path / "film.mp4", 20)
    with imageio.v2.get_reader(tmp_path / "film.mp4") as film:
        assert film.get_meta_data()["size"] == (20, 32)


def test_further_files(model, tmp_path):
    buffer = io.BytesIO()
    zipfile.ZipFile(buffer, "w").close()
    (tmp_path / "a").write_bytes(buffer.getvalue())
    folder = tmp_path / "shared"
    package_to_hub(model, folder, n_eval_episodes=1, video_length=0, extra_files={"logs/a.zip": tmp_path / "a"})
    assert (folder / "logs" / "a.zip").read_bytes() == buffer.getvalue()
    with pytest.raises(ValueError, match="no name of a file"):
        package_to_hub(model, folder, n_eval_episodes=1, video_length=0, extra_files={"../a": tmp_path / "a"})


@pytest.mark.parametrize("name", ["README.md", "./config.json", "dreamerv2-test-Counter-v0.zip", "replay.mp4"])
def test_further_files_take_no_other_s_place(model, tmp_path, name):
    (tmp_path / "a").write_text("mine")
    with pytest.raises(ValueError, match=r"extra_files must leave .* to package_to_hub, got "):
        package_to_hub(model, tmp_path / "shared", n_eval_episodes=1, video_length=0, extra_files={name: tmp_path / "a"})
    assert not (tmp_path / "shared").exists()


def test_counts_of_numpy(model, tmp_path):
    package_to_hub(model, tmp_path, n_eval_episodes=np.int64(2), video_length=np.int32(0))
    assert json.loads((tmp_path / "results.json").read_text())["n_eval_episodes"] == 2


def test_the_card_says_what_an_environment_needs_that_no_package_registers(tiny_model, tmp_path, capsys):
    model = tiny_model(CounterEnv(8)).learn(8)
    package_to_hub(model, tmp_path, CounterEnv(8), 2, env_id="my env", video_length=0, progress_bar=True)
    text = card(tmp_path).text
    assert "No package registers this environment" in text and 'gymnasium.make("my env")' not in text
    assert "2/2" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["images", "normalised vectors"])
def test_the_cards_code_makes_the_environment_with_the_same_arguments(tiny_model, tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    told = {"length": 5, "max_episode_steps": 3, "domain": "quadruped"}
    if kind == "images":
        model, shown = tiny_model(gymnasium.make(ID, **told)), "with `length=5, domain='quadruped', max_episode_steps=3`"
    else:
        del told["domain"]
        env = VecNormalize(make_vec_env(VECTORS, env_kwargs=told))
        model, shown = tiny_model(env, "MlpPolicy"), "with `length=5, max_episode_steps=3`"
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    [code] = re.findall(r"```python\n(.*?)```", card(tmp_path).text, re.DOTALL)
    names: dict = {}
    exec(code.replace("model.fine_tune()", "").replace("model.learn(50_000)", ""), names)
    spec = names["env"].spec if kind == "images" else names["env"].get_attr("spec")[0]
    assert {name: spec.kwargs.get(name, spec.max_episode_steps) for name in told} == told
    assert shown in card(tmp_path).text
    assert json.loads((tmp_path / "config.json").read_text())["env_kwargs"] == told


class Unrecorded(gymnasium.Wrapper):
    """Says nothing of its arguments."""

    def __init__(self, env, depth):
        super().__init__(env)
        self.depth = depth


class Passing(VecEnvWrapper):
    """Changes nothing."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def test_the_card_names_wrappers(tiny_model, tmp_path):
    """Those that somebody put around; neither those of gymnasium.make and of the model, nor what is in the model's file."""
    plain = VecNormalize(make_vec_env(VECTORS, wrapper_class=Unrecorded, wrapper_kwargs={"depth": 3}), norm_reward=False)
    model = tiny_model(Passing(Passing(plain)), "MlpPolicy").learn(8)
    with pytest.raises(ValueError, match=r"needs eval_env, .*record their arguments, Unrecorded, Passing, Passing:"):
        package_to_hub(model, tmp_path / "vectors", n_eval_episodes=1, video_length=0)
    eval_env = VecNormalize(make_vec_env(VECTORS, wrapper_class=Unrecorded, wrapper_kwargs={"depth": 3}), norm_reward=False)
    package_to_hub(model, tmp_path / "vectors", Passing(Passing(eval_env)), n_eval_episodes=1, video_length=0)
    found = json.loads((tmp_path / "vectors" / "config.json").read_text())["wrappers"]
    assert found == [f"{__name__}.Unrecorded(env, ...)", *[f"{__name__}.Passing(env, ...)"] * 2]
    watched = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make(VECTORS))
    wrapped = gymnasium.wrappers.TransformReward(gymnasium.wrappers.FrameStackObservation(watched, 2), abs)
    model = tiny_model(wrapped, "MlpPolicy").learn(8)
    package_to_hub(model, tmp_path / "recorded", wrapped, n_eval_episodes=1, video_length=0)
    first, second = json.loads((tmp_path / "recorded" / "config.json").read_text())["wrappers"]
    assert re.fullmatch(r"gymnasium\.wrappers\.[\w.]+\.FrameStackObservation\(env, stack_size=2, .*\)", first)
    assert re.fullmatch(r"gymnasium\.wrappers\.[\w.]+\.TransformReward\(env, func=\.\.\.\)", second)
    text = card(tmp_path / "recorded").text
    assert f"| wrappers | `{first}`, `{second}` |" in text and f"# {first}\n# {second}\nmodel = " in text


class Plus(gymnasium.RewardWrapper, gymnasium.utils.RecordConstructorArgs):
    """Says what it was made with."""

    def __init__(self, env, by):
        gymnasium.utils.RecordConstructorArgs.__init__(self, by=by)
        gymnasium.RewardWrapper.__init__(self, env)
        self.by = by

    def reward(self, reward):
        return reward + self.by["reward"]


def test_the_return_on_a_card_is_that_of_the_wrapped_environment(tiny_model, tmp_path):
    env = Plus(gymnasium.make(ID, length=5), by={"reward": 100.0})
    model = tiny_model(env).learn(8)
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["mean_reward"] > 400
    assert json.loads((tmp_path / "config.json").read_text())["wrappers"] == [f"{__name__}.Plus(env, by={{'reward': 100.0}})"]


def test_a_usual_environment_needs_no_arguments(model, tmp_path):
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    text = card(tmp_path).text
    assert 'env = gymnasium.make("test/Counter-v0")\n' in text and "wrappers" not in text


class OwnPlanner(DynaMPC):
    """A planner of somebody's own."""


class OwnReward(RandomActions):
    """A method of somebody's own."""


@pytest.fixture
def registries(monkeypatch):
    """What one test registers is gone after it."""
    for module, name in ((planners, "_KINDS"), (planners, "PLANNERS"), (methods, "_REGISTRY")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))


@pytest.mark.parametrize("by_name", [True, False])
@pytest.mark.filterwarnings("ignore:No file can hold")
def test_the_card_says_what_of_its_makers_own_is_needed(registries, tiny_model, tmp_path, by_name):
    if by_name:
        register_planner("own", OwnPlanner)
        register_intrinsic_reward("own reward", OwnReward)
    model = tiny_model(gymnasium.make(ID), planner=OwnPlanner, intrinsic_reward=OwnReward)
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    text, parts = card(tmp_path).text, json.loads((tmp_path / "config.json").read_text())["own_parts"]
    hows = {
        "planner": 'register_planner("own", OwnPlanner) first, or load(..., planner="dyna_mpc").',
        "intrinsic_reward": 'register_intrinsic_reward("own reward", OwnReward) first.',
    }
    if not by_name:
        hows = {
            "planner": 'load(..., custom_objects={"planner": OwnPlanner}), or load(..., planner="dyna_mpc").',
            "intrinsic_reward": 'load(..., custom_objects={"intrinsic_reward": OwnReward}).',
        }
    for argument, kind in (("planner", OwnPlanner), ("intrinsic_reward", OwnReward)):
        named = f"{kind.__module__}.{kind.__qualname__}"
        assert f"# Its {argument} is {named}, which this package does not have:\n# {hows[argument]}\n" in text
        assert parts[argument]["kind"] == named


@pytest.mark.filterwarnings("ignore:No file can hold")
def test_the_card_asks_for_an_object_where_the_class_would_not_do(tiny_model, tmp_path):
    planner = OwnPlanner(PlannerConfig(n_samples=8, top_k=4, horizon=3), 0.9)
    package_to_hub(tiny_model(gymnasium.make(ID), planner=planner), tmp_path, n_eval_episodes=1, video_length=0)
    assert '# load(..., custom_objects={"planner": OwnPlanner(...)}), or load(' in card(tmp_path).text


def test_what_the_package_has_needs_nothing(model, tmp_path):
    package_to_hub(model, tmp_path, n_eval_episodes=1, video_length=0)
    assert "does not have" not in card(tmp_path).text
    assert json.loads((tmp_path / "config.json").read_text())["own_parts"] == {}


def test_the_card_imports_who_registers_the_environment():
    gymnasium.register("Fake/Own-v0", entry_point="fake_envs:CounterEnv")
    try:
        assert who_registers("Fake/Own-v0") == (["import fake_envs  # registers Fake/Own-v0"], True)
    finally:
        del gymnasium.registry["Fake/Own-v0"]
    assert who_registers("urlb/walker-run-v0") == who_registers("Pendulum-v1") == ([], True)
    assert who_registers("nowhere-v0") == ([], False)


MODULE = "-m sb3_dreamer_urlb.zoo train --env urlb/walker-run-v0"


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (f"/home/me/.venv/bin/python {MODULE}", f"python {MODULE}"),
        (f"/home/my name/.venv/bin/python3.11 -u {MODULE}", f"python {MODULE}"),
        (f"C:\\Users\\me\\python.exe {MODULE}", f"python {MODULE}"),
        (f"python {MODULE}", f"python {MODULE}"),
        ("/home/me/bin/python /home/me/train.py --seed 1", "python train.py --seed 1"),
        ("sb3-dreamer-urlb x -m y", None),
        ("python train.py -f=/home/me/logs -i ~/runs/a.zip", "python train.py -f=logs -i a.zip"),
        ("python train.py -params snapshot:'/home/me/a.zip'", "python train.py -params snapshot:'a.zip'"),
        ("python train.py -f ./logs -i ../a/b.zip --url https://a.org/b/c", None),
    ],
)
def test_a_command_tells_nothing_of_the_machine(said, shown):
    assert without_private_paths(said) == (shown or said)


def test_a_card_tells_nothing_of_the_machine(tiny_model, tmp_path):
    replay = {"store": "lmdb", "path": str(tmp_path / "replay"), "map_size": 1 << 22}
    model = tiny_model(gymnasium.make("test/Counter-v0"), replay_buffer_kwargs=replay)
    package_to_hub(model, tmp_path / "hub", n_eval_episodes=1, command=f"{tmp_path}/bin/python {MODULE}", video_length=0)
    for name in ("README.md", "config.json"):
        text = (tmp_path / "hub" / name).read_text()
        assert str(tmp_path) not in text and f"python {MODULE}" in text
    assert '"path": "replay"' in (tmp_path / "hub" / "README.md").read_text()


@pytest.mark.parametrize("store", ["lmdb", "memory"])
def test_a_model_takes_none_of_its_makers_folders_along(tiny_model, weights, tmp_path, store):
    replay = {"store": store, "max_episode_rows": 20, **({"path": str(tmp_path / "replay")} if store == "lmdb" else {})}
    model = tiny_model(gymnasium.make(ID), replay_buffer_kwargs=replay, tensorboard_log=str(tmp_path / "logs")).learn(20)
    package_to_hub(model, tmp_path / "hub", n_eval_episodes=1, video_length=0)
    assert model.tensorboard_log == str(tmp_path / "logs") and model.replay_buffer_kwargs == replay
    path = load_from_hub(tmp_path / "hub")
    with zipfile.ZipFile(path) as archive:
        assert not any(str(tmp_path).encode() in archive.read(name) for name in archive.namelist())
    loaded = DreamerV2.load(path, env=gymnasium.make(ID))
    assert loaded.tensorboard_log is None and loaded.replay_buffer_kwargs.get("max_episode_rows") == 20
    assert weights(loaded.policy) == weights(model.policy) and loaded.replay_buffer.store == "memory"
    loaded.learn(4)
