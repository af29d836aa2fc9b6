# SPDX-License-Identifier: Apache-2.0
"""Experiments: plan many flights, fly them by one worker, report them.

A campaign varies a scenario by a file; the reproduction compares with the paper. Both are plans of
flights, each of a whole mission or of the controller alone.
"""
