"""Other sensors beside the lidar: fixes of a GNSS receiver on the pose graph, wheels ahead."""
