"""A scene folder as `scenes` reads it, with the record of how it was made."""
