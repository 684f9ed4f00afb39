"""Times: periods and instants as they are written, and gaps between samples."""
