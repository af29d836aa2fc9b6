# SPDX-License-Identifier: Apache-2.0
"""Stop the tumble of a target with the thrusters of the chasers latched to it
(docs/detumble.md).
"""
