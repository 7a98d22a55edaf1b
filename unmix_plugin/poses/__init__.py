"""All that moves cameras while training."""
