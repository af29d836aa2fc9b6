/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of rendering, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "elementary.h"
#include "scene.c"
#include "noise.c"
#include "mesh.c"
#include "blur.c"
