"""Effects of lidars: the pictures of docs/effects.md, and what each effect costs."""
