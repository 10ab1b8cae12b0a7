//! What an action moves: actuators, mocap bodies, and the bodies that are placed around an arm.

use super::{Resolver, within};
use crate::SimulationError;
use crate::controls::Control;
use crate::names::{ACTUATOR, BODY, GEOM, name_of};
use crate::resolved::{Area, Driven, Mount, Placement, Reading};
use crate::settled::Settling;
use crate::standing::FreeBody;
use harness_spec::{Axis, Definition, Element, Modality, clearance_setting, range_setting};
use mujoco_rs::prelude::*;

impl Resolver<'_> {
    /// Returns the modality of the actuators' setpoints and the sources of its elements.
    pub(super) fn setpoint(&self) -> (Definition, Vec<Reading>) {
        let actuators = self.world.file().action.actuators.iter();
        let element = |(name, actuator): (&str, &harness_spec::Actuator)| Element {
            name: name.to_owned(),
            unit: actuator.unit.clone(),
        };
        let elements: Vec<Element> = actuators.map(element).collect();
        let readings = (0..elements.len()).map(Reading::Setpoint).collect();
        (Definition::vector(Modality::SETPOINT, "Commanded setpoint of", elements), readings)
    }

    pub(super) fn actuators(&self) -> Result<Vec<Driven>, SimulationError> {
        let mut driven = Vec::new();
        for (name, actuator) in self.world.file().action.actuators.iter() {
            let path = format!("action.actuators.{name}");
            if let Some(body) = &actuator.mocap {
                driven.push(self.mocap(name, actuator, body)?);
                continue;
            }
            let own = match (&actuator.actuator, &actuator.actuators) {
                (Some(_), _) => format!("{path}.actuator"),
                (None, Some(_)) => format!("{path}.actuators"),
                (None, None) => path.clone(),
            };
            let ids: Vec<usize> = match &actuator.actuators {
                Some(names) => self.matches(ACTUATOR, names, &own)?.into_iter().map(|(_, id)| id).collect(),
                None => vec![self.find(ACTUATOR, actuator.actuator.as_deref().unwrap_or(name), &own)?],
            };
            let controls = ids.iter().map(|id| self.control(*id, actuator.control.as_deref(), &path, &own));
            let controls = controls.collect::<Result<Vec<Control>, _>>()?;
            let indices: Vec<usize> = controls.iter().map(|control| control.index(self.model)).collect();
            if driven.iter().any(|other: &Driven| other.controls.iter().any(|index| indices.contains(index)))
            {
                let message = "another element of the action drives the same actuator; leave one of them out";
                return Err(self.fault(&own, message));
            }
            let limits = controls.iter().map(|control| control.limits(self.model));
            let limits = limits.fold([f64::NEG_INFINITY, f64::INFINITY], |[low, high], own| {
                [low.max(own[0]), high.min(own[1])]
            });
            let [low, high] = actuator.range;
            if !within([low, high], limits) {
                let [min, max] = limits;
                let message =
                    format!("[{low}, {high}] must lie within [{min}, {max}], which the model allows");
                return Err(self.fault(&format!("{path}.range"), message));
            }
            let servos = controls.iter().filter_map(|control| control.servo(self.model));
            let qpos = servos.map(|joint| self.model.jnt_qposadr()[joint] as usize).collect();
            let setting = range_setting(name, actuator);
            driven.push(Driven { qpos, controls: indices, mocap: None, limits, setting });
        }
        for (place, one) in driven.iter().enumerate() {
            if one.mocap.is_some() && driven[..place].iter().any(|other| other.mocap == one.mocap) {
                let (name, _) = &self.world.file().action.actuators.0[place];
                let message =
                    "another element of the action moves the same coordinate; leave one of them out";
                return Err(self.fault(&format!("action.actuators.{name}.mocap"), message));
            }
        }
        Ok(driven)
    }

    /// Returns the control of an actuator that a setpoint drives. Of several controls, the world file names one.
    fn control(
        &self,
        actuator: usize,
        wanted: Option<&str>,
        path: &str,
        own: &str,
    ) -> Result<Control, SimulationError> {
        let all: Vec<Control> = Control::all_of(self.model, actuator).collect();
        let names: Vec<&str> = all.iter().filter_map(|control| control.name(self.model)).collect();
        let (name, names) = (name_of(self.model, ACTUATOR, actuator), names.join(", "));
        match (wanted, all.as_slice()) {
            (_, []) => Err(self.fault(own, format!("actuator {name} has no control; leave it out"))),
            (None, [control]) => Ok(*control),
            (None, [first, ..]) => {
                let first = first.name(self.model).unwrap_or_default();
                let message = format!(
                    "actuator {name} has the controls {names}, and a setpoint is one number; name one, such as \
                     control: {first}"
                );
                Err(self.fault(own, message))
            }
            (Some(wanted), all) => {
                let found = all.iter().find(|control| control.name(self.model) == Some(wanted));
                found.copied().ok_or_else(|| {
                    let there = match names.as_str() {
                        "" => "its only control has no name; leave this out".into(),
                        names => format!("it has {names}"),
                    };
                    let message = format!("actuator {name} has no control '{wanted}'; {there}");
                    self.fault(&format!("{path}.control"), message)
                })
            }
        }
    }

    /// Finds what else is settled at the start of an episode, besides the joints of position servos.
    pub(super) fn settling(&self, actuators: &[Driven]) -> Settling {
        let is_servo = |joint: &usize| {
            let place = self.model.jnt_qposadr()[*joint] as usize;
            actuators.iter().any(|driven| driven.qpos.contains(&place))
        };
        Settling::of(self.model, &(0..self.model.njnt() as usize).filter(is_servo).collect::<Vec<_>>())
    }

    /// The coordinate of a mocap body that follows a setpoint.
    fn mocap(
        &self,
        name: &str,
        actuator: &harness_spec::Actuator,
        body: &str,
    ) -> Result<Driven, SimulationError> {
        let path = format!("action.actuators.{name}.mocap");
        let id = self.find(BODY, body, &path)?;
        let Ok(mocap) = usize::try_from(self.model.body_mocapid()[id]) else {
            let message = format!("body '{body}' is no mocap body; write mocap=\"true\" into its element");
            return Err(self.fault(&path, message));
        };
        let axis = match actuator.axis {
            Some(Axis::Y) => 1,
            Some(Axis::Z) => 2,
            _ => 0,
        };
        Ok(Driven {
            qpos: Vec::new(),
            controls: Vec::new(),
            mocap: Some((mocap, axis)),
            limits: [f64::NEG_INFINITY, f64::INFINITY],
            setting: range_setting(name, actuator),
        })
    }

    pub(super) fn placements(&self, actuators: &[Driven]) -> Result<Vec<Placement>, SimulationError> {
        let mut placements = Vec::new();
        for (name, placing) in self.world.file().placement.iter() {
            let path = format!("placement.{name}.bodies");
            let bodies = self.matches(BODY, &placing.bodies, &path)?;
            let boxes = bodies.into_iter().map(|(name, body)| {
                let free = FreeBody::new(self.model, body);
                free.map_err(|problem| self.fault(&path, format!("body '{name}' {problem}")))
            });
            let boxes = boxes.collect::<Result<Vec<_>, _>>()?;
            let placed = placements.iter().flat_map(|other: &Placement| &other.boxes);
            if placed.into_iter().any(|placed| boxes.iter().any(|own| own.qpos == placed.qpos)) {
                let message =
                    "a body of this placement belongs to another one as well; leave it out of one of them";
                return Err(self.fault(&path, message));
            }
            let area = match (&placing.sector, placing.rectangle) {
                (Some(sector), _) => Area::Sector(self.mount(name, sector, actuators)?),
                (None, rectangle) => Area::Rectangle(rectangle.unwrap_or_default()),
            };
            let (name, setting) = (name.to_owned(), clearance_setting(name));
            placements.push(Placement { name, boxes, setting, clearance_m: placing.clearance_m, area });
        }
        Ok(placements)
    }

    /// Reads the body's place off the kinematics, and checks that the arm moves it on a vertical cylinder.
    fn mount(
        &self,
        placed: &str,
        sector: &harness_spec::Sector,
        actuators: &[Driven],
    ) -> Result<Mount, SimulationError> {
        let path = format!("placement.{placed}.sector");
        let body = self.find(BODY, &sector.body, &format!("{path}.body"))?;
        let geom = self.find(GEOM, &sector.body, &format!("{path}.body"))?;
        let names: Vec<&str> = self.world.file().action.actuators.iter().map(|(name, _)| name).collect();
        let element = |name: &str| names.iter().position(|other| *other == name).unwrap_or_default();
        let elements = [element(&sector.rotation), element(&sector.extension)];
        let [&[rotation], &[extension]] = elements.map(|element| actuators[element].qpos.as_slice()) else {
            return Err(
                self.fault(&path, "rotation and extension must each be the position servo of a joint")
            );
        };
        let is_turned = |joint: &usize| self.model.jnt_qposadr()[*joint] as usize == rotation;
        let joint = (0..self.model.njnt() as usize).find(is_turned).unwrap_or_default();
        let mut data = MjData::new(self.model);
        let mut body_at = |turned: f64, extended: f64| {
            let qpos = data.qpos_mut();
            actuators.iter().flat_map(|driven| &driven.qpos).for_each(|index| qpos[*index] = 0.0);
            (qpos[rotation], qpos[extension]) = (turned, extended);
            data.kinematics();
            (data.xpos()[body], data.xanchor()[joint])
        };
        let ([x, y, _], axis) = body_at(0.0, 0.0);
        let (dx, dy) = (x - axis[0], y - axis[1]);
        let mount = Mount {
            elements,
            axis: [axis[0], axis[1]],
            radius: dx.hypot(dy),
            bearing: dy.atan2(dx),
            body_radius: self.model.geom_size()[geom][0],
        };
        let (found, _) = body_at(0.5, 0.25);
        let expected = mount.below(0.5, 0.25);
        if (found[0] - expected[0]).hypot(found[1] - expected[1]) > 1e-6 {
            return Err(self.fault(
                &path,
                "the arm must turn the body about a vertical axis, counter-clockwise from above, and extend away from \
                 that axis",
            ));
        }
        Ok(mount)
    }
}
