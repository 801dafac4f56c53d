"""Reports: tables of accuracy, agreement and cost, whose committed results in tests/results the tests hold to bars."""
