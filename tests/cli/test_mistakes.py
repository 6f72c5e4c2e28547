"""What a user gets wrong costs a line, whatever raises it; what is nobody's mistake keeps its traceback."""

from __future__ import annotations

import gymnasium
import pytest

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.cli.mistakes import ending_in_a_line
from sb3_dreamer_urlb.zoo.mistakes import told_in_a_line


def raising(error):
    def command():
        raise error

    return command


def own_commands(error):
    return ending_in_a_line("program", raising(error))


def zoo_commands(error):
    with pytest.raises(SystemExit) as end, told_in_a_line("program"):
        raise error
    return end.value.code


def zoo_commands_uncaught(error):
    with told_in_a_line("program"):
        raise error


DOORS = pytest.mark.parametrize("door", [own_commands, zoo_commands])


@DOORS
@pytest.mark.parametrize(
    "error",
    [
        ValueError("a\nb"),
        ImportError("a b"),
        FileNotFoundError("a b"),
        IsADirectoryError("a b"),
        PermissionError("a b"),
        FileExistsError("a b"),
        OSError("a b"),
        gymnasium.error.NameNotFound("a b"),
        gymnasium.error.Error("a b"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_mistake_costs_a_line(door, error, capsys):
    assert door(error) == 2
    assert capsys.readouterr().err == "program: a b\n"


@DOORS
def test_an_argument_that_an_environment_does_not_have_costs_a_line(door, capsys):
    with pytest.raises(TypeError) as raised:
        gymnasium.make("CartPole-v1", foo=1)
    assert door(raised.value) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "unexpected keyword argument 'foo'" in error and "CartPole-v1" in error


@pytest.mark.parametrize("door", [own_commands, zoo_commands_uncaught])
@pytest.mark.parametrize(
    "error", [TypeError("a"), KeyError("a"), BrokenPipeError("a"), ConnectionResetError("a"), SystemExit(3)]
)
def test_all_else_keeps_its_traceback(door, error):
    with pytest.raises(type(error)):
        door(error)


@pytest.mark.parametrize(("args", "line"), [((), "interrupted."), (("it goes on",), "it goes on")])
def test_an_interruption_costs_a_line(args, line, capsys):
    assert ending_in_a_line("program", raising(KeyboardInterrupt(*args))) == 130
    assert capsys.readouterr().err == f"program: {line}\n"


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("figures {folder} --out {folder}/out", "Is a directory"),
        ("report {file}", "is no folder of a run"),
        ("report {folder} --out {folder}", "--out must be the path of a file, got '{folder}': that is a folder"),
        ("report {folder} --out .", "--out must be the path of a file, got '.': that is a folder"),
        ("report {folder} --out {file}/x.html", "the folder of --out must be the path of a folder"),
        ("compare {folder} --out {folder}", "--out must be the path of a file"),
        ("zero-shot x.zip --env CartPole-v1 --finetune-frames 8 --save {folder}", "--save must be the path of a file"),
        ("compare A= --out {folder}/page.html", "'A=': expected the folder of a run"),
        ("compare {folder}, --out {folder}/page.html", "expected the folder of a run"),
        ("compare {folder} --out {folder}/page.png", "is the page"),
        ("compare A={folder},{folder}/. --out {folder}/page.html", "more than once"),
        ("study modules list --folder {file} --methods lbs", "is a file"),
        ("study modules list --folder {folder} --methods lbs --preset nope", "Unknown preset 'nope'"),
        ("study modules list --folder {folder} --methods lbs --device foo", "--device must be"),
        ("study modules run --folder {folder} --methods lbs --minutes nan", "--minutes must be more than 0"),
        ("study modules run --folder {folder} --methods lbs random", "keeps pre-trained actors: random trains none"),
        ("study sparsity list --folder {folder} --methods random", "keeps pre-trained actors: random trains none"),
    ],
)
def test_commands_in_a_line(command, said, tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    assert main(command.format(folder=tmp_path, file=tmp_path / "file").split()) == 2
    error = capsys.readouterr().err
    assert said.format(folder=tmp_path) in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]
