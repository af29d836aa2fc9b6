"""The recorder process: everything that travels, verbatim, into an MCAP file."""
