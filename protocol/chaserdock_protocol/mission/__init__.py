# SPDX-License-Identifier: Apache-2.0
"""Own a mission: its time, its members and its ticks. For the world, and what takes its place."""
