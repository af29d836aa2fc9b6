# SPDX-License-Identifier: Apache-2.0
"""The central controller: fusion, references, NMPC."""
