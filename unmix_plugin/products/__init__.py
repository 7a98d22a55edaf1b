"""What `unmix-export` and `unmix-render` write."""
