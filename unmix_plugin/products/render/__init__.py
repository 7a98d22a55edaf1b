"""`unmix-render`: views as files."""
