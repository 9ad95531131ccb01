"""What every study is given: context, timing, settings."""
