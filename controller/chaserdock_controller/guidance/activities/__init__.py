# SPDX-License-Identifier: Apache-2.0
"""What a chaser does in its phases, one activity a file."""
