# SPDX-License-Identifier: Apache-2.0
"""Experiments: many flights, planned, flown by one worker, and reported.

A campaign varies a scenario by a file; the reproduction compares with the paper. Both are a plan of
flights, each of a whole mission or of the controller alone.
"""
