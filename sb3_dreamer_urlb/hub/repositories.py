"""Where models are kept: a repository on the Hugging Face Hub, or a folder that is used like one."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from sb3_dreamer_urlb.snapshots.atomic import written_atomically
from sb3_dreamer_urlb.version import __version__, how_to_install

RepoId = str | os.PathLike[str]

MISSING_HUB = f"Sharing models needs huggingface_hub and imageio-ffmpeg; {how_to_install('hub')}."
LIBRARY = "sb3_dreamer_urlb"
#: what says which file is the model; everything that `package_to_hub` makes has one
CONFIG = "config.json"
#: what the Hub allows, roughly; it says itself what exactly is wrong with a name
HUB_ID = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)


class Repository(ABC):
    """Files by name.

    :param name: for people, and for ``load_from_hub``
    :param shown: the same as a reader of the model card writes it, who may be at another machine
    """

    def __init__(self, name: str, shown: str):
        self.name, self.shown = name, shown

    @abstractmethod
    def upload(self, folder: Path, message: str) -> str:
        """Put every file of a folder there; others that are there stay.

        :param folder: with the files
        :param message: of the commit
        :return: where to look at it
        """

    @abstractmethod
    def download(self, filename: str) -> Path:
        """
        :param filename: in the repository
        :return: where the file is on this machine
        :raises FileNotFoundError: if the repository has no such file
        """


class FolderRepository(Repository):
    """A folder on this machine, or on a disk that several share.

    :param folder: made when something is put there
    :raises ValueError: if it is a file
    """

    def __init__(self, folder: Path):
        # Folders are copied, and disks are mounted elsewhere: the card lies in the folder, and so does its reader.
        super().__init__(str(folder.absolute()), "./")
        self.folder = folder
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"A repository is a folder, {folder} is a file.")

    def upload(self, folder: Path, message: str) -> str:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            with written_atomically(self.folder / path.relative_to(folder)) as file, open(path, "rb") as source:
                while block := source.read(1 << 20):
                    file.write(block)
        return str(self.folder)

    def download(self, filename: str) -> Path:
        path = self.folder / filename
        if not path.is_file():
            raise self._missing(filename)
        return path

    def _missing(self, filename: str) -> FileNotFoundError:
        if not self.folder.is_dir():
            return FileNotFoundError(2, "There is no such folder", self.name)
        if (self.folder / CONFIG).is_file():
            return FileNotFoundError(2, f"No such file in the repository {self.name}", filename)
        return FileNotFoundError(
            2,
            f"No such file in {self.name}, which holds no model that package_to_hub put there: it has no {CONFIG}. A model "
            "card's code, which says './', is run in the card's own folder",
            filename,
        )


class HubRepository(Repository):
    """A repository on the Hugging Face Hub; downloads are cached by huggingface_hub.

    :param repo_id: ``"user/name"``
    :param token: None takes the one of ``hf auth login``, or ``HF_TOKEN``
    :param revision: branch, tag or commit to fetch from
    :param private: make it private where it has to be made
    :raises ImportError: if huggingface_hub is not installed
    """

    def __init__(self, repo_id: str, token: str | None, revision: str | None, private: bool | None):
        super().__init__(repo_id, repo_id)
        try:
            from huggingface_hub import HfApi
        except ImportError as error:
            raise ImportError(MISSING_HUB) from error
        self.revision, self.private = revision, private
        self.api = HfApi(token=token, library_name=LIBRARY, library_version=__version__)

    def upload(self, folder: Path, message: str) -> str:
        url = self.api.create_repo(repo_id=self.name, private=self.private, exist_ok=True)
        self.api.upload_folder(repo_id=self.name, folder_path=folder, commit_message=message)
        return str(url)

    def download(self, filename: str) -> Path:
        from huggingface_hub.errors import RemoteEntryNotFoundError

        try:
            return Path(self.api.hf_hub_download(repo_id=self.name, filename=filename, revision=self.revision))
        except RemoteEntryNotFoundError as error:
            raise FileNotFoundError(2, f"No such file in the repository {self.name}", filename) from error


def open_repository(
    repo_id: RepoId, token: str | None = None, revision: str | None = None, private: bool | None = None
) -> Repository:
    """The repository that a user means.

    :param repo_id: ``"user/name"`` for one on the Hub; a folder as a ``Path``, as text that begins with ``.``, ``/`` or
        ``~``, or as ``file://`` address
    :param token: of the Hub
    :param revision: to fetch from; folders have none
    :param private: whether a repository that is made is private; folders are what their permissions say
    :raises ValueError: for anything else
    :raises ImportError: for one on the Hub, if huggingface_hub is not installed
    """
    folder = _folder(repo_id)
    if folder is None:
        return HubRepository(os.fspath(repo_id), token, revision, private)
    if revision is not None:
        raise ValueError(f"A folder has no revisions, got revision={revision!r} for {folder}.")
    return FolderRepository(folder)


def _folder(repo_id: RepoId) -> Path | None:
    if isinstance(repo_id, os.PathLike):
        return Path(repo_id).expanduser()
    if not isinstance(repo_id, str):
        raise ValueError(f"repo_id must be 'user/name' or a folder, got {repo_id!r}.")
    if repo_id.startswith("file:"):
        address = urlsplit(repo_id)
        if address.netloc not in ("", "localhost") or not address.path.startswith("/"):
            raise ValueError(f"A folder's address has the form file:///path, got {repo_id!r}.")
        return Path(unquote(address.path))
    if repo_id.startswith((".", "/", "~")):
        return Path(repo_id).expanduser()
    if HUB_ID.fullmatch(repo_id) is None:
        raise ValueError(
            f"repo_id must be 'user/name', or a folder: ./path, /path, ~/path, file:///path or a Path; got {repo_id!r}."
        )
    return None


def check_filename(filename: str) -> str:
    """
    :param filename: in a repository; may come from a stranger
    :raises ValueError: if it leads out of it
    """
    path = PurePosixPath(filename)
    if not filename or "\\" in filename or path.is_absolute() or ".." in path.parts or not filename.isprintable():
        raise ValueError(f"{filename!r} is no name of a file in a repository.")
    return filename
