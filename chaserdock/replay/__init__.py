# SPDX-License-Identifier: Apache-2.0
"""Replay of recorded inputs through current code, and comparison of messages field by field."""
