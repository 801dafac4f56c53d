"""Commands that measure: benchmarks, profiles, comparisons."""
