"""Sharing trained models: on the Hugging Face Hub, or in a folder that is used like a repository of it.

:func:`package_to_hub` evaluates a model, films it, writes its model card and puts all of it into a repository;
:func:`push_to_hub` puts one file there; :func:`load_from_hub` fetches one. Needs the extra ``hub``; fetching from a folder
needs nothing.
"""

from sb3_dreamer_urlb.hub.package import load_from_hub, package_to_hub, push_to_hub
from sb3_dreamer_urlb.snapshots.vec_normalize import load_vec_normalize, save_vec_normalize

__all__ = ["load_from_hub", "load_vec_normalize", "package_to_hub", "push_to_hub", "save_vec_normalize"]
