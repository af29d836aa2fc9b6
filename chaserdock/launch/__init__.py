# SPDX-License-Identifier: Apache-2.0
"""Start, watch and judge missions; operator commands, status, keys."""
