"""DrQ-v2, the benchmark's agent without a world model: one file a concern."""
