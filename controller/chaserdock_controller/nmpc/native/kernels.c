/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of the NMPC, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "elementary.h"
#include "model.h"
#include "checks.c"
#include "dynamics.c"
#include "problem.c"
#include "planes.c"
#include "riccati.c"
#include "ipm.c"
#include "tick.c"
