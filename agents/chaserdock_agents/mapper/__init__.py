# SPDX-License-Identifier: Apache-2.0
"""Map a target of unknown shape and estimate its motion, from points that chasers track."""
