//! The rules for a world file that the schema can't express.

use super::{Motion, Sensing, Source, WorldFile, one_line};
use crate::layout::{CLASS_COLORS, CONTACT_KIND, CONTACT_PARTS, Modality, NO_CONTACT, Scale};
use crate::values::ascending;
use crate::yaml::{NAME, is_name, shorten, unknown};

/// Checks the rules for a world file that the schema can't express. An error has the path at fault and the message.
pub fn check(file: &WorldFile) -> Result<(), (String, String)> {
    if file.modalities.is_empty() {
        return Err(("modalities".into(), "a world without modalities records nothing".into()));
    }
    for (name, sensing) in file.modalities.iter() {
        let at = |key: &str| format!("modalities.{name}.{key}");
        modality(file, name, sensing).map_err(|(key, message)| {
            (if key.is_empty() { format!("modalities.{name}") } else { at(key) }, message)
        })?;
    }
    if file.action.course.is_some() && !file.action.motion.is_default() {
        return Err((
            "action.motion".into(),
            "a recorded course replaces the motion; leave one of them out".into(),
        ));
    }
    probe(file).map_err(|(key, message)| (format!("action.{key}"), message.to_owned()))?;
    if file.action.actuators.is_empty() {
        return Err(("action.actuators".into(), "a world without actuators has no action".into()));
    }
    for (name, actuator) in file.action.actuators.iter() {
        named("an element of the action", name)
            .map_err(|message| (format!("action.actuators.{name}"), message))?;
        actuator.check().map_err(|message| (format!("action.actuators.{name}"), message.into()))?;
        ascending(actuator.range).map_err(|message| (format!("action.actuators.{name}.range"), message))?;
        one_line(&actuator.unit)
            .map_err(|message| (format!("action.actuators.{name}.unit"), message.into()))?;
    }
    for (name, placing) in file.placement.iter() {
        let at = |key: &str| format!("placement.{name}{key}");
        named("a placement", name).map_err(|message| (at(""), message))?;
        match (&placing.sector, &placing.rectangle) {
            (Some(sector), None) => {
                for (key, element) in [("rotation", &sector.rotation), ("extension", &sector.extension)] {
                    let all: Vec<&str> = file.action.actuators.iter().map(|(name, _)| name).collect();
                    if !all.contains(&element.as_str()) {
                        let message = unknown("element of the action", element, "", &all, str::to_owned);
                        return Err((at(&format!(".sector.{key}")), message));
                    }
                }
            }
            (None, Some(ranges)) => {
                ranges.iter().try_for_each(|range| ascending(*range)).map_err(|m| (at(".rectangle"), m))?;
            }
            _ => return Err((at(""), "give one of sector and rectangle".into())),
        }
    }
    for (name, factor) in file.factors.iter() {
        let at = |key: &str| {
            if key.is_empty() { format!("factors.{name}") } else { format!("factors.{name}.{key}") }
        };
        named("a factor", name).map_err(|message| (at(""), message))?;
        factor.check().map_err(|(key, message)| (at(&key), message))?;
    }
    for (name, colors) in file.regions.iter() {
        named("a region", name).map_err(|message| (format!("regions.{name}"), message))?;
        ascending(colors.red_minus_blue).map_err(|m| (format!("regions.{name}.red_minus_blue"), m))?;
    }
    Ok(())
}

/// Checks that a probing motion can feel something.
fn probe(file: &WorldFile) -> Result<(), (&'static str, &'static str)> {
    let is_probing = file.action.motion == Motion::Probing;
    if file.action.probe_force_n.is_some() && !is_probing {
        return Err(("probe_force_n", "only the motion 'probing' has a 'probe_force_n'"));
    }
    if is_probing && !file.modalities.iter().any(|(_, sensing)| sensing.normal_force.is_some()) {
        return Err(("motion", "a probing motion needs a touch: add a modality with a 'normal_force'"));
    }
    Ok(())
}

fn modality<'a>(file: &WorldFile, name: &str, sensing: &Sensing) -> Result<(), (&'a str, String)> {
    named("a modality", name).map_err(|message| ("", message))?;
    if Modality::RESERVED.contains(&name) {
        return Err((
            "",
            format!("'{name}' means something else in the tables; give the modality another name"),
        ));
    }
    let sources = sensing.sources().count();
    if sources != 1 {
        let found = if sources == 0 { "none" } else { "several" };
        return Err(("", format!("a modality has exactly one of {}; found {found}", Sensing::SOURCES)));
    }
    let misplaced = |key, of: &str| Err((key, format!("only {of} has '{key}'")));
    let is_camera = sensing.is_image();
    if is_camera && sensing.size.is_none() {
        return Err(("", "a camera's image needs its size: rows and columns, as [96, 96]".into()));
    }
    if !is_camera && sensing.size.is_some() {
        return misplaced("size", "a camera, an optical_flow, a depth or a segmentation");
    }
    if sensing.limit_pixels.is_some() && sensing.optical_flow.is_none() {
        return misplaced("limit_pixels", "an optical_flow");
    }
    match (&sensing.depth, sensing.range_m) {
        (Some(_), None) => return Err(("", "a depth needs the range_m that it encodes, as [0.1, 2]".into())),
        (None, Some(_)) => return misplaced("range_m", "a depth"),
        (Some(_), Some([low, high])) if low >= high => {
            return Err((
                "range_m",
                format!("the lower end must be below the upper end; found {low} and {high}"),
            ));
        }
        _ => {}
    }
    classes(sensing).map_err(|message| ("classes", message))?;
    if sensing.average_over.is_some() && sensing.normal_force.is_none() {
        return misplaced("average_over", "a normal_force");
    }
    if !sensing.contact_kinds.is_empty() {
        contact_kinds(file, name, sensing).map_err(|message| ("contact_kinds", message))?;
    }
    if sensing.unit.is_some() && sensing.sensor.is_none() {
        return misplaced("unit", "a sensor");
    }
    one_line(sensing.unit.as_deref().unwrap_or_default()).map_err(|message| ("unit", message.into()))?;
    let is_given = [
        ("scale", sensing.scale.is_some()),
        ("minimum", sensing.minimum.flatten().is_some()),
        ("percentage", sensing.percentage.is_some()),
    ];
    if let Some((key, _)) = is_given.into_iter().find(|(_, is)| *is && sensing.contact_normal.is_some()) {
        return Err((
            key,
            "only the direction of a contact_normal is learned and judged; leave this out".into(),
        ));
    }
    let is_pose = matches!(sensing.source(), Source::Pose { .. });
    for (key, is_given) in [("relative_to", sensing.relative_to.is_some()), ("set", sensing.set)] {
        if is_given && !is_pose {
            return misplaced(key, "a pose of bodies or sites");
        }
    }
    if let Some(of) = &sensing.difference_of {
        let sources: Vec<&str> =
            file.modalities.iter().filter(|(_, s)| s.difference_of.is_none()).map(|(n, _)| n).collect();
        if !sources.contains(&of.as_str()) {
            return Err(("difference_of", unknown("modality", of, "", &sources, str::to_owned)));
        }
    }
    let source =
        sensing.difference_of.as_ref().and_then(|of| file.modalities.iter().find(|(name, _)| name == of));
    let is_image = is_camera || source.is_some_and(|(_, source)| source.is_image());
    if is_image && !sensing.groups.is_empty() {
        return Err(("groups", "an image has no groups; 'regions' tell its parts apart".into()));
    }
    if is_image && sensing.scale == Some(Scale::PerElement) {
        return Err(("scale", "the values of an image share one standard deviation; use shared".into()));
    }
    if is_image && sensing.percentage.is_some() {
        return Err(("percentage", "errors of images are not given in percent".into()));
    }
    Ok(())
}

/// Checks the classes of a segmentation.
fn classes(sensing: &Sensing) -> Result<(), String> {
    let names = sensing.classes.names();
    match (&sensing.segmentation, names.len()) {
        (None, 0) => {}
        (None, _) => return Err("only a segmentation has 'classes'".into()),
        (Some(_), 0) => return Err("a segmentation needs classes, as {hand: hand_*, box: box_*}".into()),
        (Some(_), count) if count > CLASS_COLORS.len() => {
            return Err(format!("an image can encode {} classes; found {count}", CLASS_COLORS.len()));
        }
        _ => {}
    }
    names.into_iter().try_for_each(|name| named("a class", name))
}

/// Checks the kinds of contact of a force, whose values are recorded as a modality.
fn contact_kinds(file: &WorldFile, name: &str, sensing: &Sensing) -> Result<(), String> {
    if sensing.normal_force.is_none() {
        return Err("only a normal_force has 'contact_kinds'".into());
    }
    for (kind, _) in sensing.contact_kinds.iter() {
        named("a kind of contact", kind)?;
        if kind == NO_CONTACT {
            return Err(format!("'{NO_CONTACT}' means no contact; give this kind another name"));
        }
        if CONTACT_PARTS.contains(&kind) {
            return Err(format!("metrics call a phase of contacts '{kind}'; give this kind another name"));
        }
    }
    let recorded = format!("{name}{CONTACT_KIND}");
    named("the modality that records the kinds", &recorded)?;
    match file.modalities.iter().any(|(other, _)| other == recorded) {
        true => Err(format!(
            "the kinds are recorded as '{recorded}'; give the modality '{recorded}' another name"
        )),
        false => Ok(()),
    }
}

fn named(what: &str, name: &str) -> Result<(), String> {
    if is_name(name) {
        return Ok(());
    }
    let name = shorten(name);
    Err(format!(
        "'{name}' can't name {what}; use lower-case letters, digits and '_', a letter first ({NAME})"
    ))
}
