"""One module per target renderer."""
