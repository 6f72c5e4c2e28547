// ELU, and its slope taken from its output.
#pragma once

#include "vectors.h"

static inline Floats elu(Floats x) { return x > 0.0f ? x : exp(x) - 1.0f; }

static inline Floats elu_slope(Floats y) { return (y > 0.0f ? all(0) : y) + 1.0f; }
