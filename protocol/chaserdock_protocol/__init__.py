"""What every chaserdock process shares: messages, topics, frames, time, transport, scenario."""
