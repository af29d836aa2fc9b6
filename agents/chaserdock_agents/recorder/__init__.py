# SPDX-License-Identifier: Apache-2.0
"""The recorder process: everything that travels, verbatim, into an MCAP file."""
