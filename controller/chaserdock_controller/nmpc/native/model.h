/* SPDX-License-Identifier: Apache-2.0 */
#ifndef CHASERDOCK_MODEL_H
#define CHASERDOCK_MODEL_H

#include "base.h"

/* Body and discretization from `NmpcParameters`; the Runge-Kutta tableau has one subdiagonal. */
typedef struct {
    double step_s, mass_kg, per_mass, inertia[9], inverse[9], nodes[4], weights[4];
    int64_t parts;
} Model;
LAYOUT(Model, step_s, mass_kg, per_mass, inertia, inverse, nodes, weights, parts)

#endif
