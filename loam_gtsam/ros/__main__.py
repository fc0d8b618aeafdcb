"""``python -m loam_gtsam.ros`` runs the ROS 2 node."""

from loam_gtsam.ros.node import main

main()
