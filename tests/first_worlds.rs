//! `harness world new` on models with every property that could get in its way, and on public models: what it writes
//! passes the check, and what it refuses comes with a way on.

use crate::common::{finish, harness, succeed};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A folder whose name has characters that shells, YAML and patterns treat in a special way.
fn folder() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a [1] & b*?#%ä");
    fs::create_dir(&path).unwrap();
    (folder, path)
}

/// Runs a command that a message suggests in backticks, and returns the last line that it prints.
fn follow(folder: &Path, message: &str) -> String {
    let command = message.split('`').nth(1).unwrap_or_else(|| panic!("no command: {message}"));
    let words = shlex::split(command).unwrap();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[0] {
        "harness" => succeed(folder, &words[1..]).lines().last().unwrap().to_owned(),
        program => {
            let status = std::process::Command::new(program).args(&words[1..]).current_dir(folder).status();
            assert!(status.unwrap().success(), "{command}");
            String::new()
        }
    }
}

/// Collects an episode of a world.
fn collect(folder: &Path, world: &Path) {
    let text = fs::read_to_string(world).unwrap();
    let (_, modalities) = text.split_once("\nmodalities:\n  ").unwrap();
    let first = modalities.split(':').next().unwrap();
    let spec = format!(
        "name: first\nscenarios: [{:?}]\ninput: {first}\noutput: {first}\nlatent: 2\n\
         network: {{preset: multi_to_multi, hidden: [4]}}\nsimulation: {{episodes: 4, actuations_per_episode: 1}}\n",
        world.file_name().unwrap()
    );
    let path = world.with_file_name("first_spec.yaml");
    fs::write(&path, spec).unwrap();
    succeed(&folder.join("results"), &["collect", path.to_str().unwrap()]);
}

/// Parts of the models.
const GROUND: &str = "<light pos='0 0 3'/><geom name='floor' type='plane' size='2 2 .1'/>";
const ARM: &str = "<body pos='0 0 1'><joint name='x' axis='0 1 0'/><geom size='.05'/>\
                   <body pos='.3 0 0'><joint name='y' type='slide' axis='1 0 0' range='-.1 .1'/><geom size='.05'/>\
                   </body></body>";

/// A model: what it shows, the elements of `<worldbody>`, the elements after it, lines of the world file, and words of
/// its check.
type Wall = (&'static str, &'static str, &'static str, &'static [&'static str], &'static [&'static str]);

const WALLS: [Wall; 10] = [
    (
        "what has no name is called by its number",
        "<body pos='0 0 1'><joint axis='0 1 0'/><geom size='.05'/><site name='s'/><body pos='.3 0 0'>\
         <joint type='slide' axis='1 0 0'/><geom size='.05'/></body></body>",
        "<actuator><motor site='s' gear='0 0 1 0 0 0'/><motor site='s' gear='1 0 0 0 0 0' ctrlrange='-1 1'/>\
         </actuator>",
        &[
            "  joints: {joint_positions: [\"joint_0\", \"joint_1\"]}\n",
            "  contact_force: {normal_force: [\"body_1\", \"body_2\"]}\n",
            "    actuator_1: {actuator: \"actuator_1\", range: [-1.0, 1.0]}\n",
        ],
        &["2 values: joint_0 (rad), joint_1 (m)", "2 values: actuator_0, actuator_1"],
    ),
    (
        "the links of ball joints are recorded, as of belts and cables",
        "<body name='b1' pos='0 0 1'><joint name='j1' type='ball'/><geom name='g1' size='.05' fromto='0 0 0 .2 0 0' \
         type='capsule'/><body name='b2' pos='.2 0 0'><joint name='j2' type='ball'/><geom name='g2' size='.05'/></body>\
         </body>",
        "<actuator><motor joint='j1' gear='1 0 0'/></actuator>",
        &[
            "  links: {body_positions: [\"b1\", \"b2\"]}\n",
            "  contact_force: {normal_force: [\"g1\", \"g2\"]}\n",
            "  #other_joints: {joint_positions: [\"j1\", \"j2\"]}\n",
        ],
        &["6 values: b1_x (m)", "1 value: actuator_0"],
    ),
    (
        "free bodies are recorded where nothing else moves, as in heaps",
        "<body mocap='true'><geom size='.02'/></body><body pos='0 0 1'><freejoint/><geom size='.05'/></body>\
         <body pos='0 0 2'><freejoint/><geom size='.05'/></body>",
        "",
        &[
            "  body_positions: {body_positions: [\"body_2\", \"body_3\"]}\n",
            "  #other_contact_force: {normal_force: [\"body_2\", \"body_3\"]}\n",
            "    body_1_z: {mocap: \"body_1\", axis: z, unit: m, range: [-0.1, 0.1]}",
        ],
        &["6 values: body_2_x (m)"],
    ),
    (
        "a mocap body is recorded if it alone moves",
        "<body name='A' mocap='true'/><body name='a' mocap='true' pos='0 0 1'/>",
        "",
        &["  body_positions: {body_positions: [\"A\", \"a\"]}\n", "    mocap_2_x: {mocap: \"a\", axis: x"],
        &["the action: 6 values: a_x (m), a_y (m), a_z (m), mocap_2_x (m)"],
    ),
    (
        "names that YAML, patterns or columns would not take",
        "<body name='Left Arm'><joint name='*'/><geom name='[a]' size='.1'/>\
         <body name='left_arm'><joint name='ä&#10;b: #'/><geom name='a' size='.1' pos='1 0 0'/></body></body>\
         <camera name='joints_x'/><camera name='time'/><camera name='9 lives'/><camera name='joints'/>\
         <camera name='Eye' pos='0 0 4'/><camera name='eye_difference' pos='0 0 4'/>",
        "<actuator><motor name='Push it' joint='*'/><motor name='push_it' joint='*'/><motor name='推' joint='*'/>\
         </actuator>",
        &[
            "  joints: {joint_positions: [\"*\", \"ä\\nb: #\"]}\n",
            "    push_it: {actuator: \"Push it\"",
            "    actuator_1: {actuator: \"push_it\"",
            "    actuator_2: {actuator: \"推\"",
            "  camera_0: {camera: \"joints_x\"",
            "  camera_1: {camera: \"time\"",
            "  eye: {camera: \"Eye\"",
            "  camera_5: {camera: \"eye_difference\"",
        ],
        &["push_it, actuator_1, actuator_2"],
    ),
    (
        "a name that a number would be is taken",
        "<body><joint name='joint_1'/><geom size='.1'/><body><joint/><geom size='.1' pos='1 0 0'/></body></body>",
        "<actuator><motor name='m' joint='joint_1'/></actuator>",
        &["  joints: {joint_positions: [\"joint_1\"]}\n"],
        &["1 value: joint_1 (rad)"],
    ),
    (
        "sensors by kind and unit",
        ARM,
        "<tendon><fixed name='t'><joint joint='y' coef='1'/></fixed></tendon><actuator><motor name='a' joint='y'/>\
         </actuator><sensor><jointpos joint='x'/><jointpos name='slid' joint='y'/><tendonpos tendon='t'/>\
         <tendonvel tendon='t'/><actuatorfrc actuator='a'/><clock/>\
         <contact name='force_x' geom1='floor' data='found'/></sensor>",
        &[
            "  jointpos_rad: {sensor: [\"sensor_0\"], unit: \"rad\"}\n",
            "  jointpos_m: {sensor: [\"slid\"], unit: \"m\"}\n",
            "  tendonpos: {sensor: [\"sensor_2\"], unit: \"m\"}\n",
            "  tendonvel: {sensor: [\"sensor_3\"], unit: \"m/s\"}\n",
            "  actuatorfrc: {sensor: [\"sensor_4\"], unit: \"N\"}\n",
            "  contacts: {sensor: [\"force_x\"], unit: \"\"}\n",
        ],
        &["1 value: slid (m)"],
    ),
    (
        "ranges of an actuator and its joint that have nothing in common",
        ARM,
        "<actuator><position name='p' joint='y' ctrlrange='1 2'/><motor name='m' joint='x'/></actuator>",
        &["    # Left out: the ranges of \"p\" and of its joint have nothing in common.\n"],
        &["1 value: m"],
    ),
    (
        "a geom that touches nothing and has the name of its body",
        "<body name='arm' pos='0 0 1'><joint name='x'/><geom name='arm' size='.1' contype='0' conaffinity='0'/>\
         <geom size='.1'/></body>",
        "<actuator><motor joint='x'/></actuator>",
        &["  contact_force: {normal_force: [\"geom_2\"]}\n"],
        &["1 value: geom_2 (N)"],
    ),
    (
        "the vertices of a flex are no joints of a robot",
        "<flexcomp name='cloth' type='grid' count='3 3 1' spacing='.1 .1 .1' pos='0 0 1' radius='.01' dim='2' \
         mass='.1'/><body name='hand' mocap='true' pos='0 0 2'/>",
        "",
        &["  flex_force: {normal_force: [\"cloth\"]}\n", "    hand_x: "],
        &["1 value: cloth (N)"],
    ),
];

#[test]
fn a_first_world_file_of_every_wall_passes_the_check() {
    for (what, bodies, rest, lines, checked) in WALLS {
        let (_kept, folder) = folder();
        let path = |name: &str| folder.join(name).display().to_string();
        let bodies =
            bodies.replacen("<joint axis", "<joint name='x' axis", usize::from(rest.contains("'x'")));
        let model = format!("<mujoco><worldbody>{GROUND}{bodies}</worldbody>{rest}</mujoco>");
        fs::write(path("own robot.xml"), &model).unwrap();
        let world = path("own.yaml");
        succeed(&folder, &["world", "new", &path("own robot.xml"), "--output", &world]);
        let text = fs::read_to_string(&world).unwrap();
        for line in lines {
            assert!(text.contains(line), "{what}: {line}\n{text}");
        }
        let said = succeed(&folder, &["world", "check", &world]);
        for words in checked {
            assert!(said.contains(words), "{what}: {words}\n{said}");
        }
        collect(&folder, Path::new(&world));
    }
}

/// A mesh in another folder, and a file that the model includes.
const MESH: &str = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 -0.5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
const MESHES: &str = "<mujoco><asset><mesh name='m' file='m.obj'/></asset></mujoco>";

#[test]
fn a_model_without_actuators_gets_a_copy_with_some() {
    let servos = "a position servo on each of its 2 hinges and slides, and the world file for it";
    let heap = "<body name='ball' pos='0 0 1'><freejoint/><geom size='.1'/></body>";
    let mesh = "<body pos='0 0 1'><joint axis='0 1 0'/><geom type='mesh' mesh='m'/></body>";
    let chain = "<body pos='0 0 1'><joint type='ball'/><geom size='.1'/></body>";
    for (bodies, offer, line) in [
        (ARM, servos, "    \"y\": {actuator: \"y\", range: [-0.1, 0.1]}\n"),
        (mesh, "a position servo on its joint", "    joint_0: {actuator: \"joint_0\", range: [-1.0, 1.0]}\n"),
        (
            heap,
            "a mocap body that touches what moves",
            "    probe_z: {mocap: \"probe\", axis: z, unit: m, range: [1.0, ",
        ),
        (chain, "a mocap body that touches what moves", "  links: {body_positions: [\"body_1\"]}\n"),
    ] {
        let (_kept, folder) = folder();
        fs::create_dir_all(folder.join("parts/meshes")).unwrap();
        fs::create_dir(folder.join("elsewhere")).unwrap();
        let own = folder.join("parts/own.xml");
        let model = format!(
            "<mujoco><compiler meshdir='meshes'/><include file='meshes.xml'/><worldbody>{GROUND}{bodies}</worldbody>\
             </mujoco>"
        );
        fs::write(&own, model).unwrap();
        fs::write(folder.join("parts/meshes.xml"), MESHES).unwrap();
        fs::write(folder.join("parts/meshes/m.obj"), MESH).unwrap();
        let elsewhere = folder.join("elsewhere/own.yaml").display().to_string();
        for more in [&[][..], &["--output", &elsewhere]] {
            let arguments = [&["world", "new", own.to_str().unwrap()], more].concat();
            let refused = finish(&mut harness(&folder, &arguments));
            assert!(refused.code == 2 && refused.stderr.contains(offer), "{}", refused.stderr);
            let world = PathBuf::from(follow(&folder, &refused.stderr));
            let text = fs::read_to_string(&world).unwrap();
            assert!(text.contains(line), "{text}");
            succeed(&folder, &["world", "check", world.to_str().unwrap()]);
            collect(&folder, &world);
        }
        let again = ["world", "new", own.to_str().unwrap(), "--actuate"];
        let again = finish(&mut harness(&folder, &again));
        assert!(
            again.code == 2 && again.stderr.contains("own_actuated.xml exists already"),
            "{}",
            again.stderr
        );
        let copy = folder.join("parts/own_actuated.xml");
        let twice = finish(&mut harness(&folder, &["world", "new", copy.to_str().unwrap(), "--actuate"]));
        assert!(twice.code == 2 && twice.stderr.contains("leave out --actuate"), "{}", twice.stderr);
    }
}

#[test]
fn what_is_no_model_of_a_robot_is_refused_with_a_way_on() {
    let (_kept, folder) = folder();
    let path = |name: &str| folder.join(name).display().to_string();
    let refused = |arguments: &[&str]| {
        let answer = finish(&mut harness(&folder, &[&["world", "new"], arguments].concat()));
        assert!(answer.code != 0 && answer.stderr.lines().count() == 1, "{}", answer.stderr);
        answer.stderr
    };
    let arm = format!("<mujoco><worldbody>{ARM}</worldbody><actuator><motor joint='x'/></actuator></mujoco>");
    for name in ["robot.xml", "tendon.xml", "Hand-2.xml"] {
        fs::write(path(name), &arm).unwrap();
    }
    // An archive is unpacked, and its model is used.
    fs::create_dir(folder.join("packed")).unwrap();
    let zip = ["-m", "zipfile", "-c", "packed/robot.mjz", "robot.xml"];
    assert!(std::process::Command::new("python3").args(zip).current_dir(&folder).status().unwrap().success());
    let said = refused(&[&path("packed/robot.mjz")]);
    follow(&folder, &said);
    succeed(&folder, &["world", "new", &path("packed/robot/robot.xml")]);
    fs::write(path("robot.mjb"), b"\x31\xd4\0\0\x08\0\0\0").unwrap();
    let said = refused(&[&path("robot.mjb")]);
    assert!(said.contains("name the MJCF file that it was compiled from"), "{said}");
    // A world file says the same.
    fs::write(
        path("own.yaml"),
        fs::read_to_string(path("packed/robot/robot.yaml")).unwrap().replace("robot.xml", "robot.mjb"),
    )
    .unwrap();
    let said = finish(&mut harness(&folder, &["world", "check", &path("own.yaml")])).stderr;
    assert!(said.contains("own.yaml:3:8: can't read the model") && said.contains("compiled from"), "{said}");
    // A world file is no model, and no model is called like a world file.
    let own = path("packed/robot/robot.yaml");
    let said = refused(&[&own]);
    assert!(said.contains("no XML, as models in MJCF and URDF are; `harness world check '"), "{said}");
    assert!(refused(&["empty"]).contains("empty: No such file"));
    for more in [&[][..], &["--actuate"]] {
        fs::write(path("bare.xml"), format!("<mujoco><worldbody>{ARM}</worldbody></mujoco>")).unwrap();
        let said =
            refused(&[&[path("bare.xml").as_str(), "--output", &path("bare_world.xml")], more].concat());
        assert!(said.contains("the name of a world file ends in .yaml"), "{said}");
        assert!(said.contains("/bare_world.yaml'`"), "{said}");
    }
    // Names that no world has.
    let said = refused(&[&path("tendon.xml")]);
    assert!(said.contains("'tendon' is a built-in world") && !said.contains("letters"), "{said}");
    assert!(follow(&folder, &said).ends_with("/my_tendon.yaml"));
    let said = refused(&[&path("Hand-2.xml")]);
    assert!(said.contains("'Hand-2' does not have 1 to 64 lower-case letters, digits and '_'"), "{said}");
    let world = follow(&folder, &said);
    assert!(world.ends_with("/hand_2.yaml"), "{world}");
    succeed(&folder, &["world", "check", &world]);
    // Parts of models, and models of which nothing moves.
    fs::write(path("part.xml"), "<mujocoinclude><asset/></mujocoinclude>").unwrap();
    let said = refused(&[&path("part.xml")]);
    assert!(said.contains("with MuJoCo 3.") && said.contains("if other models include this file"), "{said}");
    for arguments in [&[][..], &["--actuate"]] {
        fs::write(path("still.xml"), format!("<mujoco><worldbody>{GROUND}</worldbody></mujoco>")).unwrap();
        let said = refused(&[&[path("still.xml").as_str()], arguments].concat());
        assert!(said.contains("nothing in this model moves"), "{said}");
    }
    fs::write(path("slow.xml"), arm.replace("<worldbody>", "<option timestep='100'/><worldbody>")).unwrap();
    let said = refused(&[&path("slow.xml")]);
    assert!(said.contains("no world file suits it: the world file:13:12: 'action.seconds'"), "{said}");
    for missing in ["missing.xml", "packed"] {
        let said = refused(&[&path(missing)]);
        assert!(said.contains("No such file") || said.contains("it is a folder"), "{said}");
    }
    let left: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(!left.iter().any(|name| name.to_string_lossy().contains("actuated")), "{left:?}");
    // Comments need not be UTF-8, a file without an ending gets one, and an unnamed thing that no file names is listed.
    fs::write(path("latin.xml"), [b"<mujoco><!-- f\xfcr --><compiler/>", &arm.as_bytes()[8..]].concat())
        .unwrap();
    succeed(&folder, &["world", "new", &path("latin.xml"), "--output", &path("latin")]);
    succeed(&folder, &["world", "check", &path("latin.yaml")]);
    let text = fs::read_to_string(path("latin.yaml")).unwrap();
    fs::write(path("latin.yaml"), text.replace("\"actuator_0\"", "actuator_9")).unwrap();
    let said = finish(&mut harness(&folder, &["world", "check", &path("latin.yaml")])).stderr;
    let expected = "no actuator 'actuator_9'; the model has no actuator with a name; one without a name is called by \
                    its number, such as actuator_0";
    assert!(said.contains(expected), "{said}");
}

/// Folders in which packages have models, and the folders of `MODELS`, separated by `:`.
fn folders_of_models() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let more = std::env::var("MODELS").unwrap_or_else(|_| {
        let environments =
            [".venv/lib", ".venv-models/lib"].map(|path| root.join(path).display().to_string());
        environments.join(":")
    });
    more.split(':').map(PathBuf::from).collect()
}

/// All MJCF files in a folder and below, in alphabetical order.
fn models_in(folder: &Path) -> Vec<PathBuf> {
    let entries =
        fs::read_dir(folder).unwrap_or_else(|_| panic!("no {}: setup/setup.sh --models", folder.display()));
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let is_model = |path: &Path| {
        path.extension().is_some_and(|ending| ending == "xml")
            && String::from_utf8_lossy(&fs::read(path).unwrap()).contains("<mujoco")
    };
    let found = paths.into_iter().flat_map(|path| match path.is_dir() {
        true if path.is_symlink() => Vec::new(),
        true => models_in(&path),
        false => Some(path).into_iter().filter(|path| is_model(path)).collect(),
    });
    found.collect()
}

/// What becomes of a model: what is written for it, or why nothing is.
fn outcome(folder: &Path, model: &Path) -> &'static str {
    let world = folder.join("own.yaml").display().to_string();
    let arguments = ["world", "new", model.to_str().unwrap(), "--output", &world];
    let first = finish(&mut harness(folder, &arguments));
    let said = &first.stderr;
    let outcome = match first.code {
        0 => "world file",
        _ if said.contains("a position servo") => "world file and a copy with position servos",
        _ if said.contains("a mocap body that touches") => "world file and a copy with a mocap body",
        _ if said.contains("nothing in this model moves") => return "refused: nothing moves",
        _ if said.contains("Unrecognized XML model type") => {
            return "refused: a part that other models include";
        }
        _ if said.contains("Error opening file") => {
            return "refused: a file that it uses is not in the package";
        }
        _ if said.contains("does not compile with MuJoCo") => return "refused: MuJoCo does not compile it",
        _ => panic!("{}: {said}", model.display()),
    };
    if first.code != 0 {
        follow(folder, said);
    }
    // Without a driver of OpenGL, nothing is rendered, which would take most of the time.
    let mut check = harness(folder, &["world", "check", &world, "--episodes", "1"]);
    let check = finish(check.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/none"));
    // Some test models of MuJoCo diverge while their setpoints stand still, which the check refuses.
    let is_valid = check.code == 0 || check.stderr.contains(" diverged ");
    assert!(is_valid, "{}: {}", model.display(), check.stderr);
    outcome
}

#[test]
#[ignore = "takes minutes, and packages of models: make soak"]
fn every_public_model_gets_a_world_file_or_advice() {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for model in folders_of_models().iter().flat_map(|folder| models_in(folder)) {
        let (_kept, folder) = folder();
        let outcome = outcome(&folder, &model);
        println!("{}: {outcome}", model.display());
        *counts.entry(outcome).or_default() += 1;
    }
    println!("| models | outcome |\n|---|---|");
    counts.iter().for_each(|(outcome, count)| println!("| {count} | {outcome} |"));
    assert!(counts.values().sum::<usize>() > 50, "too few models: {counts:?}");
}
