"""Structure projection: a map placed by registered frames and the scan behind them."""
