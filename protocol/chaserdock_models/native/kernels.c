/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of chaserdock_models, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "coast.c"
#include "rigid_body.c"
#include "rotations.c"
