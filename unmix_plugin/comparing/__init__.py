"""What has changed between two captures of one object: registration, significance of changes, and files."""
