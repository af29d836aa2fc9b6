# SPDX-License-Identifier: Apache-2.0
"""Evaluation of recorded flights: summary, criteria, figures, report, video."""
