/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of the physics, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "bullet.c"
