//! `harness world`: lists the worlds, checks a world file, and writes one for an MJCF model.

use super::fitness::{judge, print_judgement};
use super::format::{Destination, Form};
use super::render::save;
use super::sheet::Style;
use super::table::{print_beside, print_text, shown};
use super::{DONE, usage};
use anyhow::Result;
use clap::{Args, Subcommand};
use harness::files::write_bytes;
use harness::numbers::counted;
use harness::registry::path_word;
use harness::simulation::{
    Addable, Scene, SceneRenderer, SimulationError, actuate, check_model, draft_world, notes,
};
use harness::spec::{Definition, Modality, World, is_name, world_schema};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

#[derive(Args)]
pub struct Command {
    #[command(subcommand)]
    command: Action,
}

#[derive(Subcommand)]
enum Action {
    /// List the built-in worlds
    List,
    /// Print what each entry of a world's file matches, and whether the world is fit for learning
    ///
    /// Of several worlds, or with --format or --output, it prints or writes only the table of the latter.
    Check {
        /// World files, or names of built-in worlds
        #[arg(value_name = "WORLD", required = true)]
        worlds: Vec<String>,
        /// The number of episodes that are simulated to find out whether the world is fit for learning
        #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1000))]
        episodes: u32,
        #[command(flatten)]
        destination: Destination,
        /// A folder for a picture of every camera of the model, and for the images that networks get
        #[arg(long, value_name = "DIR")]
        render: Option<PathBuf>,
        /// Also print the names of all values of a modality with many, and of all elements of its groups
        #[arg(long)]
        all: bool,
    },
    /// Write a first world file for a model
    New {
        /// The MJCF or URDF file
        #[arg(value_name = "MODEL")]
        model: PathBuf,
        /// The world file to write. It must not exist [default: the model's path, with the ending .yaml]
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
        /// For a model without actuators: write a copy of it next to the world file, with a position servo on each
        /// hinge and slide or, if it has none, a mocap body that touches what moves
        #[arg(long)]
        actuate: bool,
    },
    /// Print the JSON schema of world files, for editors
    Schema,
}

impl Command {
    /// Runs the command.
    pub fn execute(self) -> Result<ExitCode> {
        match self.command {
            Action::List => {
                let named = |world: &Arc<World>| {
                    (format!("{:<11}", world.scenario()), world.description().to_owned())
                };
                print_beside(World::built_in().iter().map(named));
            }
            Action::Check { worlds, episodes, destination, render, all } => {
                let scenes: Vec<Scene> =
                    worlds.iter().map(|world| checked_scene(world)).collect::<Result<_>>()?;
                let scene = match (scenes.as_slice(), destination.form()?) {
                    ([scene], Form::Page(Style::Text)) => scene,
                    _ if all || render.is_some() => {
                        return Err(usage(
                            "--render and --all are about one world, without --format and --output; leave them out, or \
                             check each world alone",
                        ));
                    }
                    (scenes, form) => return judge(scenes, episodes, form),
                };
                check(scene, all)?;
                print_judgement(scene, episodes)?;
                if let Some(folder) = render {
                    render_cameras(scene, &folder)?;
                }
                for warning in scene.warnings() {
                    eprintln!("warning: {warning}");
                }
            }
            Action::New { model, output, actuate } => write_world(&model, output, actuate)?,
            Action::Schema => println!("{}", serde_json::to_string_pretty(&world_schema())?),
        }
        Ok(ExitCode::from(DONE))
    }
}

/// Compiles a world's model, and checks the rates and the start of episodes.
fn checked_scene(world: &str) -> Result<Scene> {
    let world = World::find(world)?;
    world.check_rates()?;
    let scene = Scene::new(world)?;
    scene.check_starts()?;
    Ok(scene)
}

/// Writes a first world file for a model and, if `actuate` is set, a copy of the model with what its action moves.
fn write_world(model: &Path, output: Option<PathBuf>, actuates: bool) -> Result<()> {
    check_model(model)?;
    let default = || {
        let mut name = model.file_stem().unwrap_or_default().to_owned();
        name.push(if actuates { "_actuated.yaml" } else { ".yaml" });
        model.with_file_name(name)
    };
    let mut path = output.clone().unwrap_or_else(default);
    if path.extension().is_none() {
        path.set_extension("yaml");
    }
    if !path.extension().is_some_and(|ending| ending == "yaml" || ending == "yml") {
        let command = new_command(model, Some(&path.with_extension("yaml")), actuates);
        let path = path.display();
        return Err(usage(format!(
            "{path}: the name of a world file ends in .yaml; write `harness {command}`"
        )));
    }
    check_name(model, &path, actuates)?;
    let copy = actuates.then(|| path.with_extension("xml"));
    if let Some(existing) = copy.iter().chain([&path]).find(|path| path.exists()) {
        let existing = existing.display();
        return Err(usage(format!("{existing} exists already; name another file with --output")));
    }
    let folder = |path: &Path| std::fs::canonicalize(path.parent().unwrap_or(Path::new("")).join(".")).ok();
    let is_elsewhere = folder(&path) != folder(model);
    // A world file in the model's folder names the model without a folder, others by its absolute path.
    let absolute = || std::fs::canonicalize(model).unwrap_or_else(|_| model.to_owned());
    let named = match &copy {
        None if is_elsewhere => absolute(),
        copy => copy.as_deref().unwrap_or(model).file_name().unwrap_or_default().into(),
    };
    let written = (|| -> Result<()> {
        let actuated = copy.as_ref().map(|_| actuate(model, is_elsewhere)).transpose()?;
        if let Some((copy, actuated)) = copy.as_ref().zip(actuated.as_ref()) {
            write_bytes(copy, actuated.mjcf.as_bytes())?;
        }
        let probe = actuated.as_ref().and_then(|actuated| actuated.probe.as_ref());
        let text = draft_world(copy.as_deref().unwrap_or(model), &named.to_string_lossy(), probe)?;
        Ok(write_bytes(&path, text.as_bytes())?)
    })();
    if let Err(error) = written {
        copy.iter().for_each(|copy| drop(std::fs::remove_file(copy)));
        return Err(advised(error, model, output.as_deref()));
    }
    copy.iter().chain([&path]).for_each(|path| println!("{}", shown(path)));
    Ok(())
}

/// Adds to the error of a model without actuators what can be done.
fn advised(error: anyhow::Error, model: &Path, output: Option<&Path>) -> anyhow::Error {
    let error = match error.downcast::<SimulationError>() {
        Ok(error) => error,
        Err(error) => return error,
    };
    let SimulationError::NoAction { adds, .. } = error else { return error.into() };
    let adds = match adds {
        Addable::Nothing => {
            return usage(format!(
                "{error}, but nothing in this model moves; if other models include this file, name one of them"
            ));
        }
        Addable::Servos(1) => "a position servo on its joint".to_owned(),
        Addable::Servos(count) => format!("a position servo on each of its {count} hinges and slides"),
        Addable::Probe => "a mocap body that touches what moves".to_owned(),
    };
    let command = new_command(model, output, true);
    usage(format!(
        "{error}; `harness {command}` writes a copy of the model with {adds}, and the world file for it"
    ))
}

/// Returns the arguments that write a world file.
fn new_command(model: &Path, output: Option<&Path>, actuates: bool) -> String {
    let actuate = if actuates { " --actuate" } else { "" };
    let output = output.map_or(String::new(), |output| format!(" --output {}", path_word(output)));
    format!("world new {}{actuate}{output}", path_word(model))
}

/// Refuses a path whose name can't be that of a world.
fn check_name(model: &Path, path: &Path, actuates: bool) -> Result<()> {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let is_built_in = |name: &str| World::built_in().iter().any(|world| world.scenario().name() == name);
    let why = match is_built_in(&name) {
        true => "is a built-in world",
        false if is_name(&name) => return Ok(()),
        false => "does not have 1 to 64 lower-case letters, digits and '_', a letter first",
    };
    let own: String =
        name.to_lowercase().chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    let candidates = [own.clone(), format!("my_{own}"), "my_robot".into()];
    let is_free = |name: &String| is_name(name) && !is_built_in(name);
    let other = candidates.into_iter().find(is_free).unwrap_or_default();
    let output = path.with_file_name(format!("{other}.yaml"));
    let command = new_command(model, Some(&output), actuates);
    Err(usage(format!(
        "a world is named after its file, and '{name}' {why}; write it to a file with another name: `harness {command}`"
    )))
}

fn check(scene: &Scene, all: bool) -> Result<()> {
    let names = |names: Vec<String>| listed(&names, all);
    let (world, layout) = (scene.world(), scene.layout());
    print_text(&format!("{}: {}", world.scenario(), world.description()));
    let mut entries = vec![("model".to_owned(), scene.source().to_string())];
    for definition in &layout.modalities {
        entries.push((definition.name.to_string(), describe(definition, &names)));
        for group in &definition.groups {
            let elements = definition.elements();
            let own = group.elements.iter().map(|index| elements[*index].name.clone()).collect();
            entries.push((format!("  group {}", group.name), names(own)));
        }
    }
    for (name, setting) in world.settings() {
        let setting = serde_json::to_string(&setting).unwrap_or_default();
        entries.push((format!("simulation.{name}"), setting.replace(',', ", ")));
    }
    for (name, property, drawing, elements) in scene.factors() {
        let elements = names(elements.into_iter().map(str::to_owned).collect());
        entries.push((format!("factor {name}"), format!("{property}, {drawing}: {elements}")));
    }
    entries.extend(scene.course_summary().map(|course| ("course".to_owned(), course)));
    let notes = notes(scene)?;
    if let Some(time) = notes.rendering {
        entries.push(("rendering".into(), format!("{:.1} ms for the images of a sample", 1e3 * time.own_s)));
    }
    print_beside(entries);
    if scene.boxes() > 0 {
        let are =
            if scene.boxes() == 1 { "1 body is".into() } else { format!("{} bodies are", scene.boxes()) };
        println!("{are} placed at random in each episode");
    }
    notes.notes.iter().for_each(|note| print_text(&format!("note: {note}")));
    Ok(())
}

/// Width and height of the pictures of cameras, pixels.
const PICTURE: [u32; 2] = [640, 480];

/// Writes what each camera of the model shows of the scene at rest to `camera_<name>.png`, and what a network gets from
/// each recorded image to `as_seen_<modality>.png`.
fn render_cameras(scene: &Scene, folder: &Path) -> Result<()> {
    let write = |mut renderer: SceneRenderer, name: String| -> Result<()> {
        let path = folder.join(format!("{name}.png"));
        save(&renderer.render(scene.rest())?, &path)?;
        println!("{}", shown(&path));
        Ok(())
    };
    for camera in scene.camera_names() {
        let renderer = SceneRenderer::from_camera(scene, &camera, PICTURE[0], PICTURE[1])?;
        // MuJoCo allows any sign in a name, but a file's name must not have a slash.
        write(renderer, format!("camera_{}", camera.replace('/', "_")))?;
    }
    for modality in scene.rendered() {
        write(SceneRenderer::as_recorded(scene, Some(modality.name()))?, format!("as_seen_{modality}"))?;
    }
    if scene.camera_names().is_empty() {
        print_text(
            "note: the model has no camera, so --render writes no picture; `harness render` shows the scene",
        );
    }
    Ok(())
}

/// Names with commas between them. Unless `all`, only the first and the last of many are written.
fn listed(names: &[String], all: bool) -> String {
    /// The number of names that are always written.
    const MOST: usize = 40;
    /// The number of names that are written of more.
    const FIRST: usize = 3;
    match names {
        [first @ .., last] if !all && names.len() > MOST => {
            let first = first[..FIRST].join(", ");
            format!("{first}, …, {last} ({} names; --all prints them)", names.len())
        }
        _ => names.join(", "),
    }
}

fn describe(definition: &Definition, listed: &dyn Fn(Vec<String>) -> String) -> String {
    let of = definition.difference_of.map(|of| format!("change of {of}: ")).unwrap_or_default();
    match definition.size() {
        Some([rows, columns]) => format!("{of}{} of {rows} x {columns} pixels", definition.shows()),
        None => {
            let elements = definition.elements();
            let element = |element: &harness::spec::Element| match element.unit.as_str() {
                "" => element.name.clone(),
                unit => format!("{} ({unit})", element.name),
            };
            let names: Vec<String> = elements.iter().map(element).collect();
            let what = if definition.name == Modality::SETPOINT { "the action: " } else { "" };
            format!("{what}{of}{}: {}", counted(names.len(), "value"), listed(names))
        }
    }
}
