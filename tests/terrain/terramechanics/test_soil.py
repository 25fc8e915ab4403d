import math
from dataclasses import fields

import numpy as np
import pytest
import yaml

from terrain.errors import ConfigError
from terrain.files.names import data_folder
from terrain.terramechanics.soil import LAWS, RANGES, SINKAGE, Soil, load_soil, scattered, soil_names


def test_the_eight_classes_are_there_and_have_the_numbers_of_their_law():
    names = "tiles asphalt firm_soil_gravel grass tilled_loam clay snow dry_sand"
    assert set(soil_names()) == set(names.split())
    for name in soil_names():
        soil = load_soil(name)
        assert soil.name == name
        has = {key for key in RANGES if math.isfinite(getattr(soil, key))}
        common = {"rolling_resistance_ratio", "slip_sinkage_ratio", "roughness_m3"}
        assert has - set(SINKAGE) == common | set(LAWS[soil.law])
        assert has & set(SINKAGE) in (set(), set(SINKAGE))
        assert min(soil.field_ratios()) > 0
    assert set(RANGES) == {item.name for item in fields(Soil) if item.type == "float"}


def scatter_of(entry):
    return entry["friction_angle_rad"]["scatter"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("law"), "key 'law' is missing"),
        (lambda d: d.update(law="pacejka"), "law 'pacejka' is unknown: use one of janosi, magic"),
        (lambda d: d.update(law="magic"), "key 'cohesion_pa' is unknown (accepted: name, law,"),
        (lambda d: d.pop("shear_modulus_m"), "key 'shear_modulus_m' is missing"),
        (lambda d: d["friction_angle_rad"].update(value=28.0), "friction_angle_rad is 28, at most 1.2"),
        (lambda d: d["shear_modulus_m"].update(value=0.0), "shear_modulus_m is 0.0, a number above zero"),
        (lambda d: d["cohesion_pa"].update(value=-1.0), "cohesion_pa is -1.0, a number from zero up"),
        (lambda d: d["cohesion_pa"].update(interval=[1, 2]), "key 'interval' is unknown"),
        (lambda d: d["cohesion_pa"].update(scatter=0.2), "cohesion_pa: scatter is 0.2, a mapping with run"),
        (lambda d: scatter_of(d).pop("source"), "friction_angle_rad: scatter: key 'source' is missing"),
        (lambda d: scatter_of(d).update(source=" "), "friction_angle_rad: scatter: run has no source"),
        (lambda d: scatter_of(d).update(field=8.0), "scatter: field is 8, at most 1"),
    ],
)
def test_an_impossible_soil_is_refused_in_one_sentence(tmp_path, change, message):
    described = yaml.safe_load((data_folder("soils") / "clay.yaml").read_text())
    change(described)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(described))
    with pytest.raises(ConfigError, match=r"^mine\.yaml") as error:
        load_soil(path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_soil_is_named_and_a_file_that_is_no_mapping_refused(tmp_path):
    for name in ("mud", "../soils/clay", "none.yaml"):
        with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
            load_soil(name)
    path = tmp_path / "list.yaml"
    path.write_text("- clay\n")
    with pytest.raises(ConfigError, match=r"list\.yaml is \['clay'\], a mapping with name, law is required"):
        load_soil(path)


@pytest.mark.parametrize("name", ["asphalt", "clay", "dry_sand", "tilled_loam"])
def test_scatter_has_the_spread_and_the_bounds_that_the_description_states(name):
    soil = load_soil(name)
    rng = np.random.default_rng(5)
    draws = [scattered(soil, rng) for _ in range(1000)]
    run_ratio = {entry.parameter: entry.run_ratio for entry in soil.scatter}
    for key in RANGES:
        values = np.array([getattr(draw, key) for draw in draws])
        nominal = getattr(soil, key)
        if key not in run_ratio:
            np.testing.assert_array_equal(values, nominal)
            continue
        if key == "friction_angle_rad":
            values, nominal = np.tan(values), math.tan(nominal)
        if nominal == 0:
            continue
        sigma = math.sqrt(math.log1p(run_ratio[key] ** 2))
        log = np.log(values / nominal)
        assert np.abs(log).max() <= 2 * sigma * (1 + 1e-12)
        # A normal cut at two sigma (with its tails left on the cut) keeps 0.96 of its standard deviation.
        assert abs(log.mean()) < 4 * sigma / math.sqrt(1000)
        assert log.std() == pytest.approx(0.96 * sigma, rel=0.08)
    assert scattered(soil, np.random.default_rng(3)) == scattered(soil, np.random.default_rng(3))
    assert soil == load_soil(name)
