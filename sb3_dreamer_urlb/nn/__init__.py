"""Layers, distributions, formats of products."""
