"""Callbacks of ``learn``: phases, snapshots, run folders, films. They know the algorithm, it does not know them."""
