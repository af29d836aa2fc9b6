# SPDX-License-Identifier: Apache-2.0
"""Stopping the tumble of a target with the thrusters of the chasers whose latch holds it
(docs/detumble.md).
"""
