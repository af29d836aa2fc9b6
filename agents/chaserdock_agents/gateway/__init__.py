# SPDX-License-Identifier: Apache-2.0
"""Interfaces to devices of a laboratory, one small interface for each kind of device."""
