"""DreamerV2 inside rl_zoo3: ``python -m sb3_dreamer_urlb.zoo train|enjoy|record_video|plot|push_to_hub|load_from_hub ...``.

``registration`` puts the algorithm into rl_zoo3's own dictionaries, ``sampler`` tells its ``-optimize`` what to try,
``callbacks`` are for its YAML files. Importing this imports nothing heavy.
"""
