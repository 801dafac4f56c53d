"""The cases of `warpfea stress`: each module adds its own with `@case`; `suite.load_cases` imports them all."""
