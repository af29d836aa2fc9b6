# SPDX-License-Identifier: Apache-2.0
"""Datasets of labelled images: draw views, export them in public formats, read them, and score a
perception (docs/datasets.md).
"""
