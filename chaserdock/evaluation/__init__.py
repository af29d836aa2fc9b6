# SPDX-License-Identifier: Apache-2.0
"""Evaluation of missions in one process, against ground truth: no code here flies."""
