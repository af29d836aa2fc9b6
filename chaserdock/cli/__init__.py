"""The commands of the ``chaserdock`` program, one module per topic; ``main`` assembles them."""
