"""One update: losses to optimisers, faults, CUDA graphs, memory."""
