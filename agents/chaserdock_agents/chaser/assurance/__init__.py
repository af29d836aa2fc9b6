# SPDX-License-Identifier: Apache-2.0
"""Keep commands of a chaser within its safe set, whoever sends them (docs/assurance.md)."""
