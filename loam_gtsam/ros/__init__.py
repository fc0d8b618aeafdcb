"""ROS messages and bags, and the mapper that runs live (``python -m loam_gtsam.ros``)."""
