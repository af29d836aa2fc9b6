# SPDX-License-Identifier: Apache-2.0
"""What every chaserdock process shares: messages, topics, frames, time, transport, scenario."""
