"""The default survey from Python: a local cluster, a cloud on disk, a planned path."""

from lidarpool import Planning, Scene, Survey, save_cloud, simulate

if __name__ == "__main__":
    scene = Scene.seed()
    survey = Survey(poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    centres, radii = scene.footprints[:, :2], scene.footprints[:, 2]
    planning = Planning((25, 25), (-30, -20), centres, radii, trials=100)

    result = simulate(scene, survey, planning)
    save_cloud("cloud.ply", result.points)
    print(f"{len(result.points)} points, a path of {result.plan.length:.2f} m")
