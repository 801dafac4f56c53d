"""Cases of the stress suite, one module per theme; `suite.load_cases` imports them all."""
