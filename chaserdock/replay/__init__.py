# SPDX-License-Identifier: Apache-2.0
"""Replays recorded inputs through the present code; compares messages field by field."""
