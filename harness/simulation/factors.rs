//! Factors of variation: draws random values for an episode and changes the properties of the model accordingly.

use super::SimulationError;
use super::resolve::dofs;
use super::resolved::SceneFactor;
use super::scene::Scene;
use harness_spec::{Drawing, Normal, Property, Scenario, Simulation};
use mujoco_rs::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The values that an episode draws for the factors of variation that a spec turns on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FactorValues {
    /// For each factor its index in the scene, and the values of its elements.
    drawn: Vec<(usize, Vec<f64>)>,
}

impl FactorValues {
    /// Draws each factor from its own random generator, so that its values don't depend on the other factors.
    pub(super) fn draw(scene: &Scene, spec: &Simulation, episode: u32) -> Self {
        let on = scene
            .resolved
            .factors
            .iter()
            .enumerate()
            .filter(|(_, factor)| spec.factors.contains(&factor.name));
        let draw = |(index, factor): (usize, &SceneFactor)| {
            let mut rng = stream(&factor.name, spec.stream(), scene.scenario(), episode);
            let values = factor.elements.iter().map(|_| draw_value(&factor.drawing, &mut rng)).collect();
            (index, values)
        };
        Self { drawn: on.map(draw).collect() }
    }

    /// Returns factors with these values, each for all of its elements.
    ///
    /// # Errors
    /// When the scene has no such factor, or a value is not in the factor's range.
    pub fn given(scene: &Scene, values: &BTreeMap<String, f64>) -> Result<Self, SimulationError> {
        let given = |(name, value): (&String, &f64)| {
            let refused =
                |problem: String| SimulationError::Argument(format!("the factor '{name}': {problem}"));
            let place =
                scene.resolved.factors.iter().position(|factor| factor.name == *name).ok_or_else(|| {
                    let names: Vec<&str> =
                        scene.resolved.factors.iter().map(|factor| factor.name.as_str()).collect();
                    refused(match names.as_slice() {
                        [] => format!("the world {} has no factors", scene.scenario()),
                        names => {
                            format!("the factors of the world {} are {}", scene.scenario(), names.join(", "))
                        }
                    })
                })?;
            let [low, high] = scene.resolved.factors[place].drawing.range();
            match (low..=high).contains(value) {
                true => Ok((place, vec![*value; scene.resolved.factors[place].elements.len()])),
                false => {
                    Err(refused(format!("{value} is outside of its range [{low}, {high}] in the world file")))
                }
            }
        };
        Ok(Self { drawn: values.iter().map(given).collect::<Result<_, _>>()? })
    }

    /// Returns values of one factor that all equal `value`.
    pub(super) fn of_one(scene: &Scene, factor: usize, value: f64) -> Self {
        Self { drawn: vec![(factor, vec![value; scene.resolved.factors[factor].elements.len()])] }
    }

    /// Returns all values, in the order of the elements of `factors` in [`Scene::layout_of`].
    pub fn values(&self) -> impl Iterator<Item = f64> {
        self.drawn.iter().flat_map(|(_, values)| values.iter().copied())
    }

    /// Returns the number by which a geom's size is multiplied.
    pub(super) fn size_of(&self, scene: &Scene, geom: usize) -> f64 {
        let sizes =
            self.each(scene).filter(|(property, thing, _)| (*property, *thing) == (Property::GeomSize, geom));
        sizes.map(|(_, _, values)| values[0]).product()
    }

    /// Adds to the joints' positions at the start of an episode, within the limits of the joints.
    pub(super) fn offset_joints(&self, scene: &Scene, qpos: &mut [f64]) {
        let model = &scene.model;
        for (_, joint, values) in self.each(scene).filter(|(property, ..)| *property == Property::JointStart)
        {
            let position = &mut qpos[model.jnt_qposadr()[joint] as usize];
            *position += values[0];
            if model.jnt_limited()[joint] {
                let [low, high] = model.jnt_range()[joint];
                *position = position.clamp(low, high);
            }
        }
    }

    /// Returns each factor of sensor noise by its name, with the places of its modalities in the layout and their
    /// standard deviations.
    pub(super) fn deviations<'a>(
        &'a self,
        scene: &'a Scene,
    ) -> impl Iterator<Item = (&'a str, Vec<(usize, f64)>)> {
        let drawn = self.drawn.iter().map(|(index, values)| (&scene.resolved.factors[*index], values));
        drawn.filter(|(factor, _)| factor.property == Property::SensorNoise).map(|(factor, values)| {
            let value = |place: usize| values[if factor.each { place } else { 0 }];
            let things = factor.things.iter().enumerate();
            (factor.name.as_str(), things.map(|(place, thing)| (*thing, value(place))).collect())
        })
    }

    /// Returns each change: the property, the index of the object in the model, and the values.
    fn each<'a>(&'a self, scene: &'a Scene) -> impl Iterator<Item = (Property, usize, &'a [f64])> {
        self.drawn.iter().flat_map(|(index, values)| {
            let factor = &scene.resolved.factors[*index];
            let width = factor.property.width();
            factor.things.iter().enumerate().map(move |(place, thing)| {
                let first = if factor.each { place * width } else { 0 };
                (factor.property, *thing, &values[first..first + width])
            })
        })
    }

    /// Returns a copy of `model` with these values, or `model` itself if no factor is on. It must be the scene's model,
    /// or a copy that differs only in visual settings.
    pub(super) fn apply(&self, scene: &Scene, model: &Arc<MjModel>) -> Arc<MjModel> {
        if !self.each(scene).any(|(property, ..)| property.is_of_model()) {
            return model.clone();
        }
        let mut varied = Box::new(MjModel::clone(model));
        let mut frictions: BTreeMap<usize, f64> = BTreeMap::new();
        for (property, thing, values) in self.each(scene) {
            change(&mut varied, property, thing, values);
            if property == Property::GeomFriction {
                *frictions.entry(thing).or_insert(1.0) *= values[0];
            }
        }
        prefer_frictions(&mut varied, &frictions);
        let mut data = MjData::new(varied);
        // Recomputes the constants that depend on masses, sizes and camera positions.
        data.set_const();
        // The statistics define the solver's tolerance and the clipping planes, which must stay as compiled.
        *data.model_stat_mut() = model.stat().clone();
        Arc::new(MjModel::clone(data.model()))
    }
}

/// Returns the random generator of a factor in an episode.
pub(super) fn stream(factor: &str, seed: u64, scenario: Scenario, episode: u32) -> ChaCha8Rng {
    let identity = format!("harness factor {factor}: seed {seed}, scenario {scenario}, index {episode}");
    ChaCha8Rng::from_seed(Sha256::digest(identity).into())
}

fn draw_value(drawing: &Drawing, rng: &mut impl Rng) -> f64 {
    match drawing {
        Drawing::Uniform([low, high]) => rng.random_range(*low..=*high),
        Drawing::LogUniform([low, high]) => rng.random_range(low.ln()..=high.ln()).exp().clamp(*low, *high),
        Drawing::Normal(normal) => draw_normal(normal, rng),
        Drawing::Choice(values) => values[rng.random_range(0..values.len())],
    }
}

/// Draws until a value is accepted. The mean lies within the range, so at least a third of the draws are accepted.
fn draw_normal(Normal { mean, deviation, range: [low, high] }: &Normal, rng: &mut impl Rng) -> f64 {
    loop {
        if high - low < *deviation {
            let value = rng.random_range(*low..=*high);
            let away = (value - mean) / deviation;
            if rng.random::<f64>() < (-0.5 * away * away).exp() {
                return value;
            }
        } else {
            let normal: f64 = StandardNormal.sample(rng);
            let value = mean + deviation * normal;
            if (*low..=*high).contains(&value) {
                return value;
            }
        }
    }
}

/// Number of the parameters of an affine gain or bias.
const AFFINE: usize = 3;

/// Changes a property of one object of a model.
fn change(model: &mut MjModel, property: Property, thing: usize, values: &[f64]) {
    let scale = values[0];
    match property {
        Property::JointStiffness => {
            model.jnt_stiffness_mut()[thing] *= scale;
            model.jnt_stiffnesspoly_mut()[thing].iter_mut().for_each(|value| *value *= scale);
        }
        Property::JointDamping => {
            for dof in dofs(model, thing) {
                model.dof_damping_mut()[dof] *= scale;
                model.dof_dampingpoly_mut()[dof].iter_mut().for_each(|value| *value *= scale);
            }
        }
        Property::BodyMass => {
            model.body_mass_mut()[thing] *= scale;
            model.body_inertia_mut()[thing].iter_mut().for_each(|value| *value *= scale);
        }
        Property::GeomFriction => {
            model.geom_friction_mut()[thing].iter_mut().for_each(|value| *value *= scale);
        }
        Property::GeomSize => resize(model, thing, scale),
        Property::GeomColour => {
            let mut color = color_of(model, thing);
            for (channel, offset) in color.iter_mut().zip(values) {
                *channel = (*channel + *offset as f32).clamp(0.0, 1.0);
            }
            model.geom_rgba_mut()[thing] = color;
        }
        Property::LightBrightness => {
            let of_light = [
                model.light_ambient_mut()[thing],
                model.light_diffuse_mut()[thing],
                model.light_specular_mut()[thing],
            ];
            let [ambient, diffuse, specular] = of_light.map(|color| color.map(|value| value * scale as f32));
            model.light_ambient_mut()[thing] = ambient;
            model.light_diffuse_mut()[thing] = diffuse;
            model.light_specular_mut()[thing] = specular;
        }
        Property::CameraPosition => {
            model.cam_pos_mut()[thing].iter_mut().zip(values).for_each(|(value, offset)| *value += offset);
        }
        Property::ActuatorStrength => {
            // SAFETY: the gains are those of a fixed or an affine gain, which are only factors of the force.
            let gains = unsafe { model.actuator_gainprm_mut() };
            gains[thing][..AFFINE].iter_mut().for_each(|value| *value *= scale);
            model.actuator_biasprm_mut()[thing][..AFFINE].iter_mut().for_each(|value| *value *= scale);
        }
        Property::Gravity => model.opt_mut().gravity.iter_mut().for_each(|value| *value *= scale),
        Property::JointStart | Property::SensorNoise => {}
        Property::CameraRotation => {
            let turned = product(model.cam_quat()[thing], quaternion(values));
            model.cam_quat_mut()[thing] = turned;
        }
    }
}

/// Makes the frictions of these geoms count wherever they touch others of the same priority, of which MuJoCo would take
/// the larger friction. The model's own priorities keep their order. `frictions` has the number by which each geom's
/// friction was multiplied. Contact pairs of the model have frictions of their own.
fn prefer_frictions(model: &mut MjModel, frictions: &BTreeMap<usize, f64>) {
    if frictions.is_empty() {
        return;
    }
    for (geom, priority) in model.geom_priority_mut().iter_mut().enumerate() {
        *priority = priority.saturating_mul(2).saturating_add(frictions.contains_key(&geom).into());
    }
    model.flex_priority_mut().iter_mut().for_each(|priority| *priority = priority.saturating_mul(2));
    for pair in 0..model.npair() as usize {
        let geoms = [model.pair_geom1()[pair], model.pair_geom2()[pair]];
        let scales = geoms.iter().filter_map(|geom| frictions.get(&(*geom as usize)).copied());
        if let Some(scale) = scales.reduce(f64::max) {
            model.pair_friction_mut()[pair].iter_mut().for_each(|value| *value *= scale);
        }
    }
}

/// Returns the largest number by which the factors that a spec turns on multiply a geom's size.
pub(super) fn largest_size(scene: &Scene, spec: &Simulation, geom: usize) -> f64 {
    let on = scene.resolved.factors.iter().filter(|factor| spec.factors.contains(&factor.name));
    let of_geom = on.filter(|factor| factor.property == Property::GeomSize && factor.things.contains(&geom));
    of_geom.map(|factor| factor.drawing.range()[1]).product()
}

/// Returns the color in which a geom is rendered: its own, or its material's if its own is MuJoCo's default.
pub(super) fn color_of(model: &MjModel, geom: usize) -> [f32; 4] {
    const DEFAULT: [f32; 4] = [0.5, 0.5, 0.5, 1.0];
    let own = model.geom_rgba()[geom];
    match usize::try_from(model.geom_matid()[geom]) {
        Ok(material) if own == DEFAULT => model.mat_rgba()[material],
        _ => own,
    }
}

/// Scales a geom and the bounding volumes for collision detection.
fn resize(model: &mut MjModel, geom: usize, scale: f64) {
    model.geom_size_mut()[geom].iter_mut().for_each(|value| *value *= scale);
    model.geom_aabb_mut()[geom].iter_mut().for_each(|value| *value *= scale);
    let growth = ((scale - 1.0) * model.geom_rbound()[geom]).max(0.0);
    model.geom_rbound_mut()[geom] *= scale;
    // The bounding volumes of its body must still contain it. No point of the geom moves further than `growth`.
    let body = model.geom_bodyid()[geom] as usize;
    let first = model.body_bvhadr()[body];
    let Ok(first) = usize::try_from(first) else { return };
    let count = model.body_bvhnum()[body] as usize;
    for volume in model.bvh_aabb_mut().iter_mut().skip(first).take(count) {
        volume[3..].iter_mut().for_each(|half| *half += growth);
    }
}

/// Returns the unit quaternion of a rotation vector, rad.
fn quaternion(vector: &[f64]) -> [f64; 4] {
    let angle = vector.iter().map(|value| value * value).sum::<f64>().sqrt();
    if angle == 0.0 {
        return [1.0, 0.0, 0.0, 0.0];
    }
    let (sin, cos) = (0.5 * angle).sin_cos();
    [cos, sin * vector[0] / angle, sin * vector[1] / angle, sin * vector[2] / angle]
}

/// Returns the product of two quaternions w, x, y, z.
pub(super) fn product([a, b, c, d]: [f64; 4], [e, f, g, h]: [f64; 4]) -> [f64; 4] {
    [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_stay_within_their_range_and_have_their_mean() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut mean_of = |drawing: Drawing, [low, high]: [f64; 2]| {
            let values: Vec<f64> = (0..200_000).map(|_| draw_value(&drawing, &mut rng)).collect();
            assert!(values.iter().all(|value| (low..=high).contains(value)), "{drawing}");
            values.iter().sum::<f64>() / values.len() as f64
        };
        let near =
            |found: f64, expected: f64| assert!((found - expected).abs() < 0.02, "{found}, {expected}");
        near(mean_of(Drawing::Uniform([0.5, 2.0]), [0.5, 2.0]), 1.25);
        // (b - a) / ln(b / a)
        near(mean_of(Drawing::LogUniform([0.5, 2.0]), [0.5, 2.0]), 1.5 / 4f64.ln());
        near(mean_of(Drawing::Choice(vec![1.0, 4.0]), [1.0, 4.0]), 2.5);
        // A half-normal distribution has the mean sqrt(2 / pi) of its deviation; in a narrow range it is nearly
        // uniform.
        let half = Normal { mean: 1.0, deviation: 1.0, range: [1.0, 50.0] };
        near(mean_of(Drawing::Normal(half), [1.0, 50.0]), 1.0 + (2.0 / std::f64::consts::PI).sqrt());
        let narrow = Normal { mean: 0.0, deviation: 10.0, range: [-1.0, 1.0] };
        near(mean_of(Drawing::Normal(narrow), [-1.0, 1.0]), 0.0);
    }

    #[test]
    fn a_rotation_vector_turns_by_its_length_about_its_direction() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let quarter = quaternion(&[0.0, 0.0, std::f64::consts::FRAC_PI_2]);
        assert!((quarter[0] - half).abs() < 1e-12 && (quarter[3] - half).abs() < 1e-12, "{quarter:?}");
        let whole = product(product(quarter, quarter), product(quarter, quarter));
        assert!((whole[0] + 1.0).abs() < 1e-12, "four quarters are the whole turn: {whole:?}");
        assert_eq!(quaternion(&[0.0; 3]), [1.0, 0.0, 0.0, 0.0]);
    }
}
