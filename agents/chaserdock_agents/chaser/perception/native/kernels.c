/* SPDX-License-Identifier: Apache-2.0 */
/* The kernels of perception, compiled once per instruction set (LEVEL). See base.h. */
#include "base.h"
#include "elementary.h"
#include "corners.c"
#include "cells.c"
#include "pattern.c"
#include "pose.c"
#include "views.c"
#include "mesh.c"
#include "light.c"
#include "align.c"
#include "statistical.c"
