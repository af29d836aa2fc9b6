"""``chaserdock reproduce``: the paper's table and missions, flown again and laid beside the paper's figures."""
