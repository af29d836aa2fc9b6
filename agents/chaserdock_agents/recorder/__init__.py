# SPDX-License-Identifier: Apache-2.0
"""The recorder process: writes every message, verbatim, into an MCAP file."""
