# SPDX-License-Identifier: Apache-2.0
"""Thruster control of a chaser: allocation, pulse modulation, fault detection and self-test."""
