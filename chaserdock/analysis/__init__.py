# SPDX-License-Identifier: Apache-2.0
"""What a log says about a flight."""
