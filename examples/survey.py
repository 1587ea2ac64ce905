"""Run the demo survey from Python on a local cluster, and save the cloud."""

from lidarpool import Planning, Scene, Survey, save_cloud, simulate

scene = Scene.seed()
survey = Survey(poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)], keep_every=5)
centers, radii = scene.footprints[:, :2], scene.footprints[:, 2]
planning = Planning((25, 25), (-30, -20), centers, radii, trials=100)

result = simulate(scene, survey, planning)
save_cloud(result.points, "cloud.ply")
print(f"{len(result.points)} points, a path of {result.plan.length:.2f} m")
