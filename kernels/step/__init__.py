"""The step: time levels, residual, ledger, predictor."""
