# SPDX-License-Identifier: Apache-2.0
"""Camera calibration and printable marker sheets."""
