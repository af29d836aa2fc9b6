# SPDX-License-Identifier: Apache-2.0
"""Starts, watches and judges missions; sends operator commands, shows status, makes keys."""
