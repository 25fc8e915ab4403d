"""The whole chain in Python, on the runs in ``logs/``: any layout that ``terrain convert`` reads."""

import terrain

runs = terrain.load_runs("logs/")
robot = terrain.load_robot("husky")
tracks = terrain.estimate(runs, robot)  # state and slip, with standard deviations
windows = terrain.cut_windows(tracks.runs, length_s=2.0)
model = terrain.TerrainClassifier("svm")  # a scikit-learn estimator, as is a user's own
print(terrain.cross_validate(model, windows))  # whole runs held out; the report, also in a notebook
model.fit(windows).save("field/")
table = terrain.learn_slip(tracks, robot)
why = terrain.explain(runs, robot)
why.report.save("explained.html")
sim = terrain.simulate(why.extended, "grass", "survey", seed=0)
live = terrain.Observer(model, table, robot)
for sample in terrain.replay(sim):
    live.update(sample.readings)
