"""The central controller: fusion, references, NMPC."""
