"""What can be seen of a run: pictures, observers and the Rerun viewer."""
