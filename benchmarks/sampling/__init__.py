"""Coverage and precision of estimates from samples at their own times, against their Cramér-Rao bound."""
