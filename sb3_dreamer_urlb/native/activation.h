// ELU, and its slope taken from its output.
#pragma once

#include "vectors.h"

// What is not a number passes as it is.
static inline Floats elu(Floats x) { return x <= 0.0f ? exp(x) - 1.0f : x; }

static inline Floats elu_slope(Floats y) { return (y > 0.0f ? all(0) : y) + 1.0f; }
