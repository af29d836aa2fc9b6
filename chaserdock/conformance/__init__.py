# SPDX-License-Identifier: Apache-2.0
"""Check of a foreign process against the protocol: it runs against a recorded log, and all its
messages are checked.
"""
