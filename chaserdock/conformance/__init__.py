# SPDX-License-Identifier: Apache-2.0
"""Checks that a foreign process conforms to the protocol: it runs against a recorded log, and all
its messages are checked.
"""
