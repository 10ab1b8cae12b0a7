//! Checks of a world that simulate it: whether placed bodies overlap something at the start of an episode, and whether
//! factors of variation have an effect.

use super::SimulationError;
use super::factors::{FactorValues, color_of};
use super::physics::Physics;
use super::plan::EpisodePlan;
use super::resolve::dofs;
use super::resolved::SceneFactor;
use super::scene::Scene;
use super::standing::can_touch;
use harness_shared::numbers::first_few;
use harness_spec::{Property, Simulation, SpecError};
use mujoco_rs::prelude::*;

/// Number of episodes whose start is checked.
const STARTS: u32 = 100;
/// Number of simulation steps in which the value of a factor must change something.
const STEPS: usize = 20_000;
/// Number of names in a message.
const NAMES_SHOWN: usize = 3;

impl Scene {
    /// Simulates the first step of many episodes, without factors of variation and with those that change sizes.
    ///
    /// # Errors
    /// When a placed body finds no place, or overlaps something. The error has the line of the placement.
    pub fn check_starts(&self) -> Result<(), SimulationError> {
        if self.resolved.placements.is_empty() {
            return Ok(());
        }
        let sizes = self.resolved.factors.iter().filter(|factor| factor.property == Property::GeomSize);
        let sizes: Vec<String> = sizes.map(|factor| factor.name.clone()).collect();
        let plain = self.world().simulation();
        let resized = (!sizes.is_empty()).then(|| Simulation { factors: sizes, ..plain.clone() });
        for spec in [plain].into_iter().chain(resized) {
            let mut physics = Physics::new(self, &spec)?;
            for index in 0..STARTS {
                let plan = EpisodePlan::draw(self, &spec, index)?;
                physics.start(&plan);
                physics.follow(&plan).map_err(|error| match &error {
                    SimulationError::Overlap { placement, .. } => {
                        let path = format!("placement.{placement}.bodies");
                        self.world().fault(&path, error.to_string()).into()
                    }
                    _ => error,
                })?;
            }
        }
        Ok(())
    }

    /// Returns what is allowed but is unlikely to be meant, with the line of the world file: factors of variation that
    /// change nothing, or that change more than their property.
    pub fn warnings(&self) -> Vec<SpecError> {
        let of_factor = |(place, factor): (usize, &SceneFactor)| {
            let path = format!("factors.{}.{}", factor.name, factor.property);
            let messages = self.without_effect(place, factor).into_iter().chain(self.overruled(factor));
            let message = |message: String| format!("the factor '{}' {message}", factor.name);
            messages.map(|found| self.world().fault(&path, message(found))).collect::<Vec<_>>()
        };
        self.resolved.factors.iter().enumerate().flat_map(of_factor).collect()
    }

    /// Returns why a factor, or some of what it changes, has no effect on what is recorded.
    fn without_effect(&self, place: usize, factor: &SceneFactor) -> Option<String> {
        let reasons: Vec<(usize, &str)> = factor
            .things
            .iter()
            .filter_map(|thing| Some((*thing, self.unnoticed(factor, *thing)?)))
            .collect();
        if let Some((_, reason)) = reasons.first() {
            let alike: Vec<usize> =
                reasons.iter().filter(|(_, other)| other == reason).map(|(thing, _)| *thing).collect();
            return Some(format!("changes nothing for {}, because {reason}", self.names(factor, &alike)));
        }
        let [low, high] = factor.drawing.range();
        let neutral = factor.property.neutral();
        let same: Vec<usize> = if !factor.property.is_of_model() {
            if [low, high] == [neutral; 2] { factor.things.clone() } else { Vec::new() }
        } else {
            let models =
                [low, high].map(|value| FactorValues::of_one(self, place, value).apply(self, &self.model));
            let is_same = |thing: &usize| {
                let of = |model: &MjModel| values(model, factor.property, *thing);
                models.iter().all(|model| of(model) == of(&self.model))
            };
            factor.things.iter().copied().filter(is_same).collect()
        };
        if !same.is_empty() {
            let names = self.names(factor, &same);
            return Some(format!("changes nothing for {names}: no value that is drawn changes the model"));
        }
        let is_moved = match factor.property {
            Property::JointStiffness
            | Property::JointDamping
            | Property::BodyMass
            | Property::GeomFriction
            | Property::ActuatorStrength
            | Property::Gravity
            | Property::JointStart => true,
            Property::GeomSize => !factor.things.iter().any(|geom| self.sees(*geom)),
            _ => false,
        };
        let tried: Vec<f64> = [low, high].into_iter().filter(|value| is_moved && *value != neutral).collect();
        let mut idle = Vec::new();
        for value in &tried {
            match self.has_effect(place, factor, *value) {
                Ok(true) => {}
                Ok(false) => idle.push(value.to_string()),
                Err(error) => return Some(format!("can't be simulated with the value {value}: {error}")),
            }
        }
        let seconds = STEPS as f64 * self.step_s();
        (!idle.is_empty()).then(|| {
            format!("changed nothing in {seconds} s of simulation with the value {}", idle.join(" or "))
        })
    }

    /// Returns why a change of an object can't be noticed; `None` if it may be.
    fn unnoticed(&self, factor: &SceneFactor, thing: usize) -> Option<&'static str> {
        let model = &self.model;
        let is_recorded = || self.images().any(|image| image.camera == thing);
        let touches = || (0..model.ngeom() as usize).any(|other| may_touch(model, thing, other));
        match factor.property {
            Property::BodyMass if model.body_weldid()[thing] == 0 => Some("the model can't move it"),
            Property::GeomFriction if !touches() && model.nflex() == 0 => Some("nothing can touch it"),
            Property::GeomSize if !self.sees(thing) && !can_touch(model, thing) => {
                Some("no camera sees it and nothing can touch it")
            }
            Property::GeomColour if !self.sees(thing) || self.resolved.cameras.is_empty() => {
                Some("no camera sees it")
            }
            Property::LightBrightness if self.resolved.cameras.is_empty() => Some("no image is recorded"),
            Property::LightBrightness if !model.light_active()[thing] => Some("it is off"),
            Property::CameraPosition | Property::CameraRotation if !is_recorded() => {
                Some("no modality records its image")
            }
            _ => None,
        }
    }

    /// Whether a recorded camera could see a geom.
    fn sees(&self, geom: usize) -> bool {
        let model = &self.model;
        let is_opaque = model.geom_rgba()[geom][3] > 0.0;
        self.images().next().is_some() && model.geom_group()[geom] < 3 && is_opaque
    }

    /// Simulates episodes with the model's own values and with this value of a factor, until they differ.
    fn has_effect(&self, place: usize, factor: &SceneFactor, value: f64) -> Result<bool, SimulationError> {
        let plain = Simulation { actuations_per_episode: 3, ..self.world().simulation() };
        let varied = Simulation { factors: vec![factor.name.clone()], ..plain.clone() };
        let values = FactorValues::of_one(self, place, value);
        let (mut one, mut other) = (Physics::new(self, &plain)?, Physics::new(self, &varied)?);
        let samples_each = one.timing.samples;
        let episodes = STEPS.div_ceil(samples_each * one.timing.steps_per_sample);
        for index in 0..episodes as u32 {
            let own = EpisodePlan::draw(self, &plain, index)?;
            let changed = EpisodePlan::with_factors(self, &varied, index, values.clone())?;
            one.start(&own);
            other.start(&changed);
            for _ in 0..samples_each {
                one.follow(&own)?;
                other.follow(&changed)?;
                let (one, other) = (&one.instant, &other.instant);
                if one.state != other.state || one.forces != other.forces || one.sensors != other.sensors {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// Returns how a factor of friction changes contacts besides scaling their friction: without it, MuJoCo combines
    /// the properties of both geoms.
    fn overruled(&self, factor: &SceneFactor) -> Option<String> {
        if factor.property != Property::GeomFriction {
            return None;
        }
        let model = &self.model;
        let others = || (0..model.ngeom() as usize).filter(|geom| !factor.things.contains(geom));
        let pairs = factor.things.iter().flat_map(|geom| others().map(move |other| (*geom, other)));
        let mut pairs = pairs.filter(|(geom, other)| {
            model.geom_priority()[*geom] == model.geom_priority()[*other] && may_touch(model, *geom, *other)
        });
        let friction = |geom: usize| model.geom_friction()[geom];
        let solver =
            |geom: usize| (model.geom_condim()[geom], model.geom_solref()[geom], model.geom_solimp()[geom]);
        pairs.find_map(|(geom, other)| {
            let names = [geom, other].map(|geom| self.geom_name(geom));
            let is_less = (0..3).any(|kind| friction(geom)[kind] < friction(other)[kind]);
            let what = match (is_less, solver(geom) != solver(other)) {
                (true, _) => "friction",
                (false, true) => "condim, solref and solimp",
                (false, false) => return None,
            };
            let [own, touched] = names;
            Some(format!(
                "also changes the contacts of {own} and {touched}: while it is on, they have the {what} of {own} \
                 alone, not those that MuJoCo combines from both; set the same {what} for both in the model, or a \
                 priority"
            ))
        })
    }

    /// Returns the names of some of a factor's objects.
    fn names(&self, factor: &SceneFactor, things: &[usize]) -> String {
        let all = factor.things.iter().zip(&factor.names);
        let named = all.filter(|(thing, _)| things.contains(thing)).map(|(_, name)| format!("'{name}'"));
        first_few(&named.collect::<Vec<_>>(), NAMES_SHOWN)
    }
}

/// Returns the values of a property of an object.
fn values(model: &MjModel, property: Property, thing: usize) -> Vec<f64> {
    match property {
        Property::JointStiffness => vec![model.jnt_stiffness()[thing]],
        Property::JointDamping => dofs(model, thing).map(|dof| model.dof_damping()[dof]).collect(),
        Property::BodyMass => vec![model.body_mass()[thing]],
        Property::GeomFriction => model.geom_friction()[thing].to_vec(),
        Property::GeomSize => model.geom_size()[thing].to_vec(),
        Property::GeomColour => color_of(model, thing)[..3].iter().copied().map(f64::from).collect(),
        Property::LightBrightness => {
            let lights = [model.light_ambient(), model.light_diffuse(), model.light_specular()];
            lights.iter().flat_map(|of| of[thing].map(f64::from)).collect()
        }
        Property::CameraPosition => model.cam_pos()[thing].to_vec(),
        Property::CameraRotation => model.cam_quat()[thing].to_vec(),
        Property::ActuatorStrength => {
            [model.actuator_gainprm()[thing], model.actuator_biasprm()[thing]].concat()
        }
        Property::Gravity => model.opt().gravity.to_vec(),
        Property::JointStart | Property::SensorNoise => Vec::new(),
    }
}

/// Whether MuJoCo looks for contacts of two geoms.
fn may_touch(model: &MjModel, one: usize, other: usize) -> bool {
    let is_pair = |pair: usize| {
        let geoms = [model.pair_geom1()[pair] as usize, model.pair_geom2()[pair] as usize];
        geoms == [one, other] || geoms == [other, one]
    };
    if (0..model.npair() as usize).any(is_pair) {
        return true;
    }
    let bodies = [one, other].map(|geom| model.geom_bodyid()[geom]);
    let welds = bodies.map(|body| model.body_weldid()[body as usize]);
    let parents = welds.map(|weld| model.body_weldid()[model.body_parentid()[weld as usize] as usize]);
    let is_parent = !welds.contains(&0) && (parents[0] == welds[1] || parents[1] == welds[0]);
    let is_filtered = is_parent && model.opt().disableflags & MjtDisableBit::mjDSBL_FILTERPARENT as i32 == 0;
    let [a, b] = bodies;
    let is_excluded =
        model.exclude_signature().iter().any(|pair| *pair == (a << 16) + b || *pair == (b << 16) + a);
    let bits = |one: usize, other: usize| model.geom_contype()[one] & model.geom_conaffinity()[other] != 0;
    welds[0] != welds[1] && !is_filtered && !is_excluded && (bits(one, other) || bits(other, one))
}
