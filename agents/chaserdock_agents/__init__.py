# SPDX-License-Identifier: Apache-2.0
"""Processes of a mission besides world and controller: chasers, recorder, router."""
