# SPDX-License-Identifier: Apache-2.0
"""Deterministic simulation of whole missions: all processes in one, over a simulated network, in
virtual time.
"""
