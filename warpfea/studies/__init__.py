"""Commands that measure: benchmarks, profiles, studies. They print tables and write the files of tests/results."""
