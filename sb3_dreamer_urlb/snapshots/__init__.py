"""Files that hold models, policies and replay buffers, and that can never run code (docs/reliability.md, "Snapshots")."""

from sb3_dreamer_urlb.snapshots.archive import SnapshotError

__all__ = ["SnapshotError"]
