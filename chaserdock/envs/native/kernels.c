/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of chaserdock.envs, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "batch.c"
