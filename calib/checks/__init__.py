"""One way of doubting: checks with p-values, of recordings and of fits."""
