//! What the objects of a model are called: by their names or, without one, by their kinds and numbers.

use mujoco_rs::prelude::*;

/// A kind of things that a world file names, and the word for it.
pub(super) type ObjectKind = (MjtObjBase, &'static str);

pub(super) const JOINT: ObjectKind = (MjtObjBase::mjOBJ_JOINT, "joint");
pub(super) const GEOM: ObjectKind = (MjtObjBase::mjOBJ_GEOM, "geom");
pub(super) const BODY: ObjectKind = (MjtObjBase::mjOBJ_BODY, "body");
pub(super) const SENSOR: ObjectKind = (MjtObjBase::mjOBJ_SENSOR, "sensor");
pub(super) const SITE: ObjectKind = (MjtObjBase::mjOBJ_SITE, "site");
pub(super) const CAMERA: ObjectKind = (MjtObjBase::mjOBJ_CAMERA, "camera");
pub(super) const LIGHT: ObjectKind = (MjtObjBase::mjOBJ_LIGHT, "light");
pub(super) const ACTUATOR: ObjectKind = (MjtObjBase::mjOBJ_ACTUATOR, "actuator");
pub(super) const FLEX: ObjectKind = (MjtObjBase::mjOBJ_FLEX, "flex");
pub(super) const KEYFRAME: ObjectKind = (MjtObjBase::mjOBJ_KEY, "keyframe");

/// Largest number of names in an error's list of what there is.
const NAMES_LISTED: usize = 40;
/// Largest number of names in a note.
pub(super) const NAMES_SHOWN: usize = 10;

/// Returns the number of objects of a kind.
pub(super) fn count(model: &MjModel, (kind, _): ObjectKind) -> usize {
    let count = match kind {
        MjtObjBase::mjOBJ_JOINT => model.njnt(),
        MjtObjBase::mjOBJ_GEOM => model.ngeom(),
        MjtObjBase::mjOBJ_BODY => model.nbody(),
        MjtObjBase::mjOBJ_SENSOR => model.nsensor(),
        MjtObjBase::mjOBJ_CAMERA => model.ncam(),
        MjtObjBase::mjOBJ_LIGHT => model.nlight(),
        MjtObjBase::mjOBJ_SITE => model.nsite(),
        MjtObjBase::mjOBJ_FLEX => model.nflex(),
        MjtObjBase::mjOBJ_KEY => model.nkey(),
        _ => model.nactuator(),
    };
    count as usize
}

/// Returns the name of an object; `None` if it has none.
fn own_name(model: &MjModel, (kind, _): ObjectKind, id: usize) -> Option<&str> {
    model.id_to_name(kind, id).filter(|name| !name.is_empty())
}

/// Returns the names and indices of all named objects of a kind, in the model's order.
pub(super) fn named(model: &MjModel, kind: ObjectKind) -> Vec<(&str, usize)> {
    (0..count(model, kind)).filter_map(|id| Some((own_name(model, kind, id)?, id))).collect()
}

/// Returns what an object is called: its name or, if it has none, the word for its kind and its number, counted from 0:
/// `joint_4`. It is `None` if that is the name of another object.
pub(super) fn called(model: &MjModel, kind: ObjectKind, id: usize) -> Option<String> {
    let number = || Some(format!("{}_{id}", kind.1)).filter(|name| model.name_to_id(kind.0, name).is_none());
    own_name(model, kind, id).map(str::to_owned).or_else(number)
}

/// Returns what each object of a kind is called, and its index, in the model's order.
pub(super) fn all_called(model: &MjModel, kind: ObjectKind) -> Vec<(String, usize)> {
    (0..count(model, kind)).filter_map(|id| Some((called(model, kind, id)?, id))).collect()
}

/// Returns what an object is called, in quotes.
pub(super) fn name_of(model: &MjModel, kind: ObjectKind, id: usize) -> String {
    called(model, kind, id).map_or("one without a name".into(), |name| format!("'{name}'"))
}

/// Returns the names and indices of the objects of a kind that have a name, or that one of the `asked` calls by its
/// number, in the model's order.
pub(super) fn named_or_asked<'n>(
    model: &'n MjModel,
    kind: ObjectKind,
    asked: impl IntoIterator<Item = &'n str>,
) -> Vec<(&'n str, usize)> {
    let numbered = |name: &'n str| {
        let id: usize = name.strip_prefix(kind.1)?.strip_prefix('_')?.parse().ok()?;
        let is_it = id < count(model, kind) && called(model, kind, id).as_deref() == Some(name);
        is_it.then_some((name, id))
    };
    let mut all = named(model, kind);
    all.extend(asked.into_iter().filter_map(numbered));
    all.sort_by_key(|(_, id)| *id);
    all.dedup();
    all
}

/// Returns what a message says of the objects of a kind that a world file can name.
pub(super) fn listed(model: &MjModel, kind: ObjectKind) -> String {
    let (all, word) = (named(model, kind), kind.1);
    let names: Vec<&str> = all.iter().take(NAMES_LISTED).map(|(name, _)| *name).collect();
    let more = if all.len() > NAMES_LISTED { ", …" } else { "" };
    let there = match names.is_empty() {
        true => format!("the model has no {word} with a name"),
        false => format!("the model has {}{more}", names.join(", ")),
    };
    let unnamed = (0..count(model, kind)).filter(|id| own_name(model, kind, *id).is_none());
    match unnamed.filter_map(|id| called(model, kind, id)).next() {
        None => there,
        Some(first) => format!("{there}; one without a name is called by its number, such as {first}"),
    }
}
