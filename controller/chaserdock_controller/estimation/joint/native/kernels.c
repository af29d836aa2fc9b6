/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of the joint filter, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "elementary.h"
#include "layout.h"
#include "rotations.c"
#include "cholesky.c"
#include "motion.c"
#include "covariance.c"
#include "measurements.c"
#include "update.c"
