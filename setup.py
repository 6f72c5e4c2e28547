"""The metadata stands in setup.cfg. What it cannot say: the wheel brings zoo_configs/, which lies beside the package."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SOURCE, TARGET = Path("zoo_configs"), "sb3_dreamer_urlb/zoo_configs"


class BuildWithConfigs(build_py):
    """An editable install reads them where they are."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for source, target in self._configs().items():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *map(str, self._configs().values())]

    def _configs(self) -> dict[Path, Path]:
        return {path: Path(self.build_lib, TARGET, path.relative_to(SOURCE)) for path in sorted(SOURCE.rglob("*.yml"))}


setup(cmdclass={"build_py": BuildWithConfigs})
