//! The figures, drawn from small real runs of the paper's two experiments.

use crate::common::finger::FRAME_LEN;
use crate::common::{MULTI, SINGLE, SMOKE, TINY, finish, fresh, harness, succeed};
use harness::analysis::{LEVEL, mean_interval};
use harness::catalog::query;
use harness::collection::dataset_of;
use harness::figures::Figure;
use harness::figures::page::{Anchor, Page, Stroke, Type};
use harness::figures::source::{integers, texts};
use harness::learning::network::architecture;
use harness::registry::Registry;
use harness::simulation::Scene;
use harness::spec::{Modality, Scenario, Simulation, Task};
use harness::tables::TableFile;
use polars::prelude::*;
use resvg::usvg::{self, roxmltree};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

const EPISODES: u32 = 4;
const ACTUATIONS: u32 = 3;

fn run(results: &Path, spec: &str, more: &[&str]) {
    let arguments: Vec<&str> = ["run", spec].iter().chain(&TINY).chain(more).copied().collect();
    succeed(results, &arguments);
}

/// Runs of both experiments with two scenarios and two seeds. The datasets are removed, so only tables are left, as in
/// published results.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = fresh("figures");
    run(&results, SINGLE, &["latent=[2,4]"]);
    run(&results, MULTI, &["latent=[4]", "network.channels=[4]"]);
    fs::rename(results.join("datasets"), fresh("figures_datasets")).unwrap();
    results
});

/// All figures of [`RESULTS`].
static DRAWN: LazyLock<PathBuf> = LazyLock::new(|| {
    let out = fresh("figures_drawn");
    succeed(&RESULTS, &["figures", "--output", out.to_str().unwrap()]);
    out
});

fn read(folder: &Path, figure: Figure, ending: &str) -> Vec<u8> {
    fs::read(folder.join(format!("{}.{ending}", figure.name()))).unwrap()
}

fn csv(figure: Figure) -> DataFrame {
    let path = DRAWN.join(format!("{}.csv", figure.name()));
    CsvReader::new(fs::File::open(path).unwrap()).finish().unwrap()
}

fn real(table: &DataFrame, column: &str, row: usize) -> Option<f64> {
    let value = table.column(column).unwrap().get(row).unwrap();
    if value.is_null() { None } else { Some(value.try_extract::<f64>().unwrap()) }
}

fn text(table: &DataFrame, column: &str, row: usize) -> String {
    table.column(column).unwrap().get(row).unwrap().str_value().into_owned()
}

fn svg(figure: Figure) -> String {
    String::from_utf8(read(&DRAWN, figure, "svg")).unwrap()
}

/// The texts of a figure.
fn words(figure: Figure) -> BTreeSet<String> {
    words_of(&svg(figure))
}

/// The texts of an SVG file.
pub fn words_of(svg: &str) -> BTreeSet<String> {
    let document = roxmltree::Document::parse(svg).unwrap();
    let labeled = document.descendants().filter(|node| node.has_tag_name("g"));
    labeled.filter_map(|node| node.attribute("aria-label")).map(str::to_owned).collect()
}

#[test]
fn a_figure_without_rows_suggests_a_run_only_if_it_adds_some() {
    let (results, folder) = (fresh("figures_without_rows"), tempfile::tempdir().unwrap());
    let smoke = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE)).unwrap();
    for name in ["single_to_multi", "multi_to_multi"] {
        let spec = folder.path().join(name).with_extension("yaml");
        let own = smoke.replace("name: smoke\n", &format!("name: {name}\n")) + "tasks: [prediction]\n";
        fs::write(&spec, own).unwrap();
        succeed(&results, &["run", spec.to_str().unwrap()]);
    }
    let asked = ["figures", "reconstruction_performance", "--output", results.to_str().unwrap()];
    let draw = |place: &Path| finish(harness(&results, &asked).current_dir(place));
    // The built-in spec of this name asks for reconstruction too, and the one in the folder does not.
    let more = draw(Path::new(env!("CARGO_MANIFEST_DIR"))).stderr;
    assert!(
        more.contains("have no rows") && more.contains(" run single_to_multi` makes runs that have"),
        "{more}"
    );
    let same = draw(folder.path()).stderr;
    assert!(same.contains("have no rows") && !same.contains(" run single_to_multi"), "{same}");
}

#[test]
fn a_figure_with_too_many_series_leaves_out_baselines_first() {
    let (results, out) = (fresh("figures_of_many"), fresh("figures_of_many_drawn"));
    let widths: Vec<String> = (0..14).map(|n| format!("w{n:02}: {{network.hidden: {}}}", n + 2)).collect();
    let vary = format!("vary={{width: {{{}}}}}", widths.join(", "));
    let vectors = ["scenarios=empty", "input=proprioception", "output=[proprioception, contact_force]"];
    let network = ["network.preset=single_to_multi", "training.epochs=1", "window.horizon=2"];
    let more = ["name=many", "tasks=prediction", &vary];
    succeed(&results, &[&["run", SMOKE][..], &vectors, &network, &more].concat());
    let drawn = |networks: usize| {
        let widths: Vec<String> = (0..networks).map(|n| format!("width=w{n:02}")).collect();
        let chosen: Vec<&str> = widths.iter().flat_map(|width| ["--where", width]).collect();
        let options = ["--experiment", "many", "--format", "svg", "--output", out.to_str().unwrap()];
        succeed(&results, &[&["figures", "horizon"], &options[..], &chosen].concat());
        words_of(&fs::read_to_string(out.join("horizon.svg")).unwrap())
    };
    for (networks, left_out) in
        [(10, "ridge"), (11, "ridge, training mean"), (14, "training mean, 3 of 14 networks")]
    {
        let words = drawn(networks);
        let remark =
            format!("more than 12 series: {}", if networks > 12 { "ridge, " } else { "" }) + left_out;
        assert!(words.iter().any(|text| text.ends_with(&remark)), "{remark}: {words:?}");
        assert!(!words.iter().any(|text| text.ends_with(", persistence")), "{words:?}");
        assert!(words.contains("persistence") && words.contains("w10") == (networks > 10), "{words:?}");
        assert_eq!(words.contains("training mean"), networks == 10, "{words:?}");
        assert!(!words.contains("w11"), "{words:?}");
    }
}

#[test]
fn panels_name_the_inputs_of_the_runs_that_they_show() {
    let out = fresh("figures_inputs");
    let figures = [Figure::PredictionResults, Figure::Regression];
    let more = ["--single", "multi_to_multi", "--format", "svg", "--out", out.to_str().unwrap()];
    succeed(&RESULTS, &[&["figures"][..], &figures.map(Figure::name), &more].concat());
    for figure in figures {
        let svg = String::from_utf8(read(&out, figure, "svg")).unwrap();
        assert!(svg.contains("from proprioception + vision\""), "{}", figure.name());
        assert!(!svg.contains("from proprioception\""), "{}", figure.name());
    }
}

#[test]
fn diagrams_show_all_layers_of_deep_networks() {
    let results = fresh("figures_network");
    let settings =
        ["network.hidden=[8,8]", "network.channels=[2,3]", "network.fusion=late", "network.average=2"];
    run(&results, MULTI, &[&["latent=[4]", "scenarios=[empty]", "seeds=[0]"][..], &settings].concat());
    let out = results.join("figures");
    let figures = [Figure::PredictiveArch, Figure::InformationLossArch];
    let names = figures.map(Figure::name);
    succeed(&results, &[&["figures", "--output", out.to_str().unwrap()][..], &names].concat());
    for (figure, action) in figures.into_iter().zip([1, 0]) {
        let svg = String::from_utf8(read(&out, figure, "svg")).unwrap();
        assert_whole(&svg, figure.name());
        let count = |words: &str| svg.matches(&format!("aria-label=\"{words}")).count();
        assert_eq!([count("convolution"), count("transposed conv."), count("layer norm.")], [2, 2, 2]);
        // The encoder has 2 fully connected layers for vectors, and one for images, for both and for the latent state.
        // The decoder has 2 hidden layers and the last one, for vectors and for images.
        assert_eq!(count("fully conn"), 5 + 6);
        // 2 convolutions, 2 layers for vectors in each part, and the transposed convolution before the last.
        assert_eq!(count("ReLU\""), 2 + 4 + 1);
        // The encoder averages images of 64 x 64, and the decoder does not.
        assert_eq!([count("mean of 2 × 2 pixels"), count("8 × 8 × 3\""), count("16 × 16 × 3\"")], [1; 3]);
        // The latent state of 4 and the action of 3 go to two layers.
        assert_eq!([count("side by side"), count("7\"")], [action; 2]);
    }
}

#[test]
fn diagrams_of_networks_without_a_camera_have_one_column() {
    let out = fresh("figures_vectors");
    let figures = [Figure::PredictiveArch, Figure::InformationLossArch];
    let more = ["--multi", "single_to_multi", "--format", "svg", "--output", out.to_str().unwrap()];
    succeed(&RESULTS, &[&["figures"][..], &figures.map(Figure::name), &more].concat());
    for figure in figures {
        let svg = String::from_utf8(read(&out, figure, "svg")).unwrap();
        assert_whole(&svg, figure.name());
        let count = |words: &str| svg.matches(&format!("aria-label=\"{words}")).count();
        assert_eq!([count("fully connected, ReLU\""), count("fully connected\"")], [2, 2]);
        assert_eq!([count("convolution"), count("fully conn.")], [0, 0]);
        assert_eq!(count("2 or 4\""), 1);
    }
}

/// Rectangles with a border, which are the blocks of a diagram: left, top, right and bottom, in points.
fn blocks(svg: &str) -> Vec<[f64; 4]> {
    let document = roxmltree::Document::parse(svg).unwrap();
    let boxes = document.descendants().filter(|node| node.has_tag_name("rect") && node.has_attribute("rx"));
    let edges = |node: roxmltree::Node| {
        let [x, y, width, height] =
            ["x", "y", "width", "height"].map(|name| node.attribute(name).unwrap().parse::<f64>().unwrap());
        [x, y, x + width, y + height]
    };
    boxes.map(edges).collect()
}

fn assert_apart(svg: &str) {
    let blocks = blocks(svg);
    assert!(blocks.len() > 6, "{blocks:?}");
    for (index, a) in blocks.iter().enumerate() {
        for b in &blocks[index + 1..] {
            assert!(a[2] <= b[0] || b[2] <= a[0] || a[3] <= b[1] || b[3] <= a[1], "{a:?} covers {b:?}");
        }
    }
}

/// The SVG and the CSV file of a diagram of an experiment's networks.
fn diagram(results: &Path, experiment: &str, figure: Figure) -> (String, DataFrame) {
    let out = results.join("figures");
    let name = figure.name();
    succeed(results, &["figures", name, "--multi", experiment, "--output", out.to_str().unwrap()]);
    let table = CsvReader::new(fs::File::open(out.join(format!("{name}.csv"))).unwrap()).finish().unwrap();
    let svg = String::from_utf8(read(&out, figure, "svg")).unwrap();
    assert_whole(&svg, name);
    assert_apart(&svg);
    (svg, table)
}

/// The number of parameters of the only run of a results folder, by the layers that its network lists.
fn parameters_of(results: &Path) -> usize {
    let [(_, record)] = &Registry::new(results).recorded()[..] else { panic!("one run") };
    let trained = record.spec.trained().unwrap();
    let architecture = architecture(&record.spec, trained, &record.layout, Task::Prediction);
    architecture.summary().unwrap().parameters()
}

#[test]
fn diagrams_show_the_memory_of_a_network() {
    for (memory, expected) in [
        ("gru", [("gated recurrent unit", 1), ("last ", 0), ("not seen", 0), ("with a", 1)]),
        ("window", [("gated recurrent unit", 0), ("last 5 samples", 1), ("not seen", 0), ("each with a", 1)]),
        ("rssm", [("GRU", 1), ("last ", 0), ("not seen", 1), ("with z", 1)]),
    ] {
        let results = fresh(&format!("figures_{memory}"));
        let setting = format!("network.memory={memory}");
        let more = [
            "latent=[4]",
            "scenarios=[empty]",
            "seeds=[0]",
            "window.context=8",
            "window.horizon=2",
            &setting,
        ];
        run(&results, SINGLE, &more);
        // A reconstruction is of samples that are seen.
        let (seen, _) = diagram(&results, "single_to_multi", Figure::InformationLossArch);
        assert!(seen.contains("with memory, frozen") && !seen.contains("not seen"));
        let (svg, table) = diagram(&results, "single_to_multi", Figure::PredictiveArch);
        let count = |words: &str| svg.matches(&format!("aria-label=\"{words}")).count();
        assert_eq!(expected.map(|(words, _)| (words, count(words))), expected, "{memory}");
        assert_eq!(count("fusion encoder f with memory"), 1);
        let drawn: u64 = table.column("values").unwrap().as_materialized_series().sum().unwrap();
        assert_eq!(drawn as usize, parameters_of(&results), "{memory}");
        let names = table.column("parameter").unwrap().str().unwrap();
        assert!(names.iter().flatten().any(|name| name.starts_with("memory.")), "{memory}");
    }
}

#[test]
fn diagrams_show_what_the_objects_of_a_set_share() {
    let results = fresh("figures_set");
    let more = [
        "latent=[4]",
        "scenarios=[crowded]",
        "seeds=[0]",
        "tasks=[prediction]",
        "input=[proprioception, arm, pillars_from_arm]",
        "network.fusion=late",
    ];
    run(&results, SINGLE, &more);
    let (svg, table) = diagram(&results, "single_to_multi", Figure::PredictiveArch);
    assert_eq!(svg.matches("aria-label=\"sum and maximum of").count(), 1);
    let drawn: u64 = table.column("values").unwrap().as_materialized_series().sum().unwrap();
    assert_eq!(drawn as usize, parameters_of(&results));
}

#[test]
fn diagrams_show_the_experts_of_a_product_side_by_side() {
    let results = fresh("figures_product");
    let more = [
        "latent=[4]",
        "scenarios=[empty]",
        "seeds=[0]",
        "tasks=[prediction]",
        "input=[proprioception, arm, vision]",
        "network.preset=multi_to_multi",
        "network.fusion=product",
    ];
    run(&results, SINGLE, &more);
    let (svg, table) = diagram(&results, "single_to_multi", Figure::PredictiveArch);
    assert_eq!(svg.matches("aria-label=\"product of experts").count(), 1);
    // Both vectors have blocks of their own, which are too narrow for the words.
    assert_eq!(svg.matches("aria-label=\"FC").count(), 4);
    let drawn: u64 = table.column("values").unwrap().as_materialized_series().sum().unwrap();
    assert_eq!(drawn as usize, parameters_of(&results));
}

#[test]
fn a_figure_says_that_it_leaves_out_latent_sizes() {
    let results = fresh("figures_latents");
    let more = ["scenarios=[cluttered]", "seeds=[0]", "latent=[2,3,4,5]"];
    run(&results, SINGLE, &more);
    let out = results.join("figures");
    let figures = ["regression", "--multi", "single_to_multi", "--output", out.to_str().unwrap()];
    succeed(&results, &[&["figures"][..], &figures].concat());
    let svg = fs::read_to_string(out.join("regression.svg")).unwrap();
    assert!(svg.contains("z = 4") && !svg.contains("z = 5"));
    assert!(svg.contains("only the 3 smallest latent sizes are drawn; the CSV file has all"));
    assert!(fs::read_to_string(out.join("regression.csv")).unwrap().contains(",5,"));
    assert!(!words(Figure::Regression).iter().any(|text| text.contains("smallest latent sizes")));
}

#[test]
fn all_nine_are_drawn_from_tables_alone() {
    assert!(!RESULTS.join("datasets").exists());
    let names: BTreeSet<String> =
        fs::read_dir(&*DRAWN).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap()).collect();
    let ending =
        |figure: &Figure| ["csv", "pdf", "png", "svg"].map(|ending| format!("{}.{ending}", figure.name()));
    assert_eq!(names, Figure::OF_THE_PAPER.iter().flat_map(ending).collect());
    assert_eq!(names.len(), 9 * 4);
    for figure in Figure::OF_THE_PAPER {
        let picture = image::load_from_memory(&read(&DRAWN, figure, "png")).unwrap().into_rgb8();
        // 8.5 cm at 600 pixels per inch.
        assert_eq!(picture.width(), 2008, "{}", figure.name());
        let colors: BTreeSet<[u8; 3]> = picture.pixels().map(|pixel| pixel.0).collect();
        assert!(colors.len() > 20, "{} has {} colors", figure.name(), colors.len());
        assert!(csv(figure).height() > 0);
    }
}

#[test]
fn every_svg_is_whole_self_contained_and_within_its_page() {
    for figure in Figure::OF_THE_PAPER {
        assert_whole(&svg(figure), figure.name());
    }
}

#[test]
fn the_text_of_a_pdf_is_text_in_a_font_of_the_program() {
    for figure in Figure::OF_THE_PAPER {
        let pdf = read(&DRAWN, figure, "pdf");
        let has = |words: &str| pdf.windows(words.len()).any(|place| place == words.as_bytes());
        assert!(pdf.starts_with(b"%PDF-"), "{}", figure.name());
        // Programs that search or copy a text need the map from glyphs to letters.
        assert!(has("+Roboto-Regular") && has("/ToUnicode"), "{}", figure.name());
    }
}

pub fn assert_whole(svg: &str, name: &str) {
    let document = roxmltree::Document::parse(svg).unwrap();
    // The SVG must need no font and no other file.
    assert!(!document.descendants().any(|node| node.has_tag_name("text")));
    let ids: BTreeSet<&str> = document.descendants().filter_map(|node| node.attribute("id")).collect();
    for reference in document.descendants().filter_map(|node| node.attribute("href")) {
        let found = reference.strip_prefix('#').map(|id| ids.contains(id));
        assert!(found.unwrap_or_else(|| reference.starts_with("data:image/png;base64,")), "{reference}");
    }
    let tree = usvg::Tree::from_str(svg, &usvg::Options::default()).unwrap();
    let (size, drawn) = (tree.size(), tree.root().abs_stroke_bounding_box());
    assert!(drawn.left() >= -0.1 && drawn.top() >= -0.1, "{name}: {drawn:?}");
    assert!(drawn.right() <= size.width() + 0.1, "{name}: {drawn:?} of {size:?}");
    assert!(drawn.bottom() <= size.height() + 0.1, "{name}: {drawn:?} of {size:?}");
}

#[test]
fn the_same_tables_give_the_same_bytes() {
    let again = fresh("figures_again");
    succeed(&RESULTS, &["figures", "--output", again.to_str().unwrap(), "--threads", "1"]);
    for figure in Figure::OF_THE_PAPER {
        for ending in ["svg", "png", "pdf", "csv"] {
            assert!(
                read(&DRAWN, figure, ending) == read(&again, figure, ending),
                "{} {ending}",
                figure.name()
            );
        }
    }
}

#[test]
fn axes_have_units() {
    let has = |figure, expected: &[&str]| {
        let words = words(figure);
        expected.iter().for_each(|text| assert!(words.contains(*text), "{text} is not among {words:?}"));
    };
    let errors = [
        "proprioception, SMAPE (%)",
        "contact force, WMAPE (%)",
        "contact force, R²",
        "latent size (2 seeds)",
    ];
    has(Figure::PredictionResults, &errors);
    has(Figure::ReconstructionPerformance, &["proprioception, SMAPE (%)", "latent size (2 seeds)"]);
    let forces = ["samples in contact (%)", "force in contact (N)", "samples with ≥ force (%)", "force (N)"];
    has(Figure::ForcesDataset, &forces);
    let regression = ["predicted (rad)", "reference (rad)", "predicted (N)", "reference (N)"];
    has(Figure::Regression, &regression);
    has(Figure::PropriovisionToVision, &["empty", "cluttered", "camera", "reference", "z = 4"]);
}

#[test]
fn curves_are_means_and_intervals_of_what_a_query_finds() {
    let registry = Registry::new(&*RESULTS);
    for (figure, models) in [(Figure::PredictionResults, 2), (Figure::ReconstructionPerformance, 1)] {
        let table = csv(figure);
        let mut rows = BTreeMap::new();
        for row in 0..table.height() {
            let cell = |column| text(&table, column, row);
            let latent = real(&table, "latent", row);
            *rows.entry((cell("panel"), cell("model"))).or_insert(0) += 1;
            let sql = format!(
                "select value from metrics where experiment = '{}' and task = '{}' and modality = '{}' and \
                 metric = '{}' and scenario = '{}' and direction = '{}' and model = '{}' and \"index\" is null{}",
                cell("experiment"),
                cell("task"),
                cell("modality"),
                cell("metric"),
                cell("scenario"),
                cell("direction"),
                cell("model"),
                latent.map_or(String::new(), |latent| format!(" and latent = {latent}")),
            );
            let found = query(&registry, &sql).unwrap();
            let values: Vec<f64> = found.column("value").unwrap().f64().unwrap().iter().flatten().collect();
            let expected = mean_interval(&values, LEVEL).unwrap();
            let mean = real(&table, "mean", row).unwrap();
            assert!((mean - expected.mean).abs() <= 1e-12 * mean.abs(), "{sql}");
            if latent.is_some() {
                assert_eq!(values.len(), 2, "{sql}");
                let ends = (real(&table, "low", row).unwrap(), real(&table, "high", row).unwrap());
                assert_eq!(ends, expected.bounds.unwrap(), "{sql}");
            } else {
                assert_eq!((real(&table, "low", row), real(&table, "high", row)), (None, None));
            }
        }
        // The network has values for two scenarios and two directions at each latent size, the baseline has them once.
        // In the test episode of `empty`, no even link is touched, so the forces of one direction have no R2.
        let of = |panel: &str, model: &str| rows.get(&(panel.into(), model.into())).copied().unwrap_or(0);
        assert_eq!(of("a", "network"), 4 * 2);
        assert_eq!(of("b", "network"), if models == 2 { 3 * 2 } else { 4 });
        assert_eq!(of("a", "persistence"), if models == 2 { 4 } else { 0 });
    }
}

#[test]
fn panels_say_what_bars_are_over_and_what_predicting_zero_gives() {
    for figure in [Figure::PredictionResults, Figure::ReconstructionPerformance] {
        let svg = svg(figure);
        let panels = if figure == Figure::PredictionResults { 6 } else { 2 };
        assert_eq!(svg.matches("latent size (2 seeds)").count(), panels);
        // A black dashed line across a panel, or a note with an arrow where it lies above. For R², it is that of the
        // mean.
        let line = svg.matches("stroke=\"#1a1a1a\" stroke-width=\"0.6\" stroke-dasharray").count();
        assert_eq!(line + svg.matches("predicting zero: 100 %").count(), panels, "{}", figure.name());
    }
}

#[test]
fn pictures_with_the_most_motion_are_shown() {
    let table = csv(Figure::PropriovisionToVision);
    let registry = Registry::new(&*RESULTS);
    for scenario in ["empty", "cluttered"] {
        let shown: BTreeSet<u64> = (0..table.height())
            .filter(|row| text(&table, "scenario", *row) == scenario)
            .map(|row| real(&table, "motion", row).unwrap().to_bits())
            .collect();
        let sql = format!(
            "select distinct motion from frames where experiment = 'multi_to_multi' and scenario = '{scenario}' \
             and task = 'prediction' order by motion"
        );
        let kept = query(&registry, &sql).unwrap();
        assert_eq!(kept.height(), 5);
        let most = (2..5).map(|row| real(&kept, "motion", row).unwrap().to_bits()).collect();
        assert_eq!(shown, most);
        let words = words(Figure::PropriovisionToVision);
        for motion in &shown {
            let motion = format!("motion {:.1} %", 100.0 * f64::from_bits(*motion));
            assert!(words.contains(&motion), "{motion} is not among {words:?}");
        }
    }
}

#[test]
fn a_null_where_a_figure_needs_a_value_is_an_error() {
    let table = df!("latent" => [Some(4i64), None], "scenario" => [Some("empty"), None]).unwrap();
    assert!(integers(&table, "latent").unwrap_err().to_string().contains("'latent' contains null"));
    assert!(texts(&table, "scenario").unwrap_err().to_string().contains("'scenario' contains null"));
    assert_eq!(integers(&table.head(Some(1)), "latent").unwrap(), [4]);
}

/// The pictures in a part of an SVG.
fn pictures<'a>(group: &'a usvg::Group) -> Vec<&'a usvg::Image> {
    let of = |node: &'a usvg::Node| match node {
        usvg::Node::Image(image) => vec![&**image],
        usvg::Node::Group(group) => pictures(group),
        _ => Vec::new(),
    };
    group.children().iter().flat_map(of).collect()
}

/// The images of a world need not have the size of another's.
#[test]
fn image_changes_of_any_size_are_saved_whole_and_drawn_as_wide() {
    let (folder, results) = (tempfile::tempdir().unwrap(), fresh("figures_sizes"));
    fs::write(folder.path().join("wide.xml"), include_str!("../models/empty.xml")).unwrap();
    let world = include_str!("../models/empty.yaml");
    let world = world.replace("model: empty.xml", "model: wide.xml").replace("[64, 64]", "[32, 96]");
    fs::write(folder.path().join("wide.yaml"), world).unwrap();
    let scenarios = format!("scenarios=[empty,{}]", folder.path().join("wide.yaml").display());
    run(&results, MULTI, &["latent=[2]", "seeds=[0]", "network.channels=[4]", &scenarios]);
    let out = results.join("drawn");
    succeed(&results, &["figures", "propriovision_to_vision", "--output", out.to_str().unwrap()]);
    let path = out.join("propriovision_to_vision.csv");
    let table = CsvReader::new(fs::File::open(path).unwrap()).finish().unwrap();
    // Three trials, each with a reference and a prediction.
    let [empty, wide] = ["empty", "wide"].map(|scenario| {
        let is_of: BooleanChunked =
            (0..table.height()).map(|row| Some(text(&table, "scenario", row) == scenario)).collect();
        table.filter(&is_of).unwrap()
    });
    assert_eq!((empty.height(), wide.height()), (3 * 2 * 64, 3 * 2 * 32));
    let filled = |table: &DataFrame, column: &str| table.column(column).unwrap().null_count() == 0;
    assert!(filled(&empty, "column_63") && !filled(&empty, "column_64") && filled(&wide, "column_95"));
    assert!(table.column("column_96").is_err());
    assert_eq!(real(&wide, "row", 31), Some(31.0));
    assert_eq!(real(&wide, "row", 32), Some(0.0));

    let svg = fs::read_to_string(out.join("propriovision_to_vision.svg")).unwrap();
    let tree = usvg::Tree::from_str(&svg, &usvg::Options::default()).unwrap();
    let mut drawn: BTreeMap<[u32; 2], usize> = BTreeMap::new();
    // The bar of colors has a single row.
    for image in pictures(tree.root()).into_iter().filter(|image| image.size().height() > 1.0) {
        let (pixels, place) = (image.size(), image.abs_bounding_box());
        let (of_pixels, of_place) = (pixels.width() / pixels.height(), place.width() / place.height());
        assert!((of_pixels / of_place - 1.0).abs() < 0.01, "{pixels:?} in {place:?}");
        *drawn.entry([pixels.width() as u32, pixels.height() as u32]).or_default() += 1;
    }
    // Each trial has the camera's image, the reference and a prediction.
    assert_eq!(drawn, BTreeMap::from([([64, 64], 9), ([96, 32], 9)]));
}

#[test]
fn datasets_are_told_apart() {
    let results = fresh("figures_datasets_apart");
    let more = ["latent=[2]", "scenarios=[empty]", "seeds=[0]", "vary={simulation.seed: [0, 1]}"];
    run(&results, SINGLE, &more);
    run(&results, MULTI, &[&more[..], &["network.channels=[4]"]].concat());
    let out = results.join("drawn");
    let names = ["forces_dataset", "prediction_results"];
    succeed(&results, &[&["figures"], &names[..], &["--output", out.to_str().unwrap()]].concat());
    let read = |name: &str| {
        CsvReader::new(fs::File::open(out.join(format!("{name}.csv"))).unwrap()).finish().unwrap()
    };
    let [forces, errors] = names.map(read);
    let svg = fs::read_to_string(out.join("prediction_results.svg")).unwrap();
    assert!(svg.contains("latent size (2 datasets)"));

    // A distribution is that of one dataset.
    let first = "select index, max(contacts) as contacts, max(mean) as mean from forces join runs \
                 using (experiment, run, scenario, latent) where dataset_seed = 0 and modality = 'contact_force' \
                 and episode is null group by index order by index";
    let first = query(&Registry::new(&results), first).unwrap();
    assert_eq!((forces.height(), first.height()), (20, 20));
    for row in 0..20 {
        for column in ["contacts", "mean"] {
            let (drawn, stored) = (real(&forces, column, row), real(&first, column, row));
            assert!((drawn.unwrap() - stored.unwrap()).abs() < 1e-9, "{column} of link {row}");
        }
    }

    // A baseline has a value on each dataset.
    let rows = (0..errors.height()).filter(|row| text(&errors, "model", *row) == "persistence");
    let mut baselines = 0;
    for row in rows {
        let sql = format!(
            "select distinct dataset_seed, value from metrics join runs using (experiment, run, scenario, latent) \
             where experiment = '{}' and task = 'prediction' and modality = '{}' and metric = '{}' \
             and direction = '{}' and model = 'persistence' and index is null",
            text(&errors, "experiment", row),
            text(&errors, "modality", row),
            text(&errors, "metric", row),
            text(&errors, "direction", row),
        );
        let found = query(&Registry::new(&results), &sql).unwrap();
        assert_eq!(found.height(), 2, "{sql}");
        // Without any contact, the error of a force is not defined.
        let values: Vec<f64> = (0..2).filter_map(|row| real(&found, "value", row)).collect();
        let expected = mean_interval(&values, LEVEL).unwrap();
        assert_eq!(real(&errors, "mean", row), Some(expected.mean));
        assert_eq!(real(&errors, "high", row), expected.bounds.map(|(_, high)| high));
        baselines += usize::from(values.len() == 2);
    }
    assert!(baselines >= 4, "{baselines}");
}

#[test]
fn only_the_formats_that_are_asked_for_are_written() {
    let out = fresh("figures_formats");
    let arguments = ["figures", "forces_dataset", "--output", out.to_str().unwrap(), "--format"];
    let files = || {
        let names = fs::read_dir(&out).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
        names.collect::<BTreeSet<String>>()
    };
    let said = succeed(&RESULTS, &[&arguments[..], &["png"]].concat());
    assert!(said.contains("forces_dataset.png"), "{said}");
    assert_eq!(files(), BTreeSet::from(["forces_dataset.png".to_owned()]));
    assert!(read(&out, Figure::ForcesDataset, "png") == read(&DRAWN, Figure::ForcesDataset, "png"));
    succeed(&RESULTS, &[&arguments[..], &["svg,csv"]].concat());
    assert_eq!(files().len(), 3);
    let refused = finish(&mut harness(&RESULTS, &[&arguments[..], &["eps"]].concat()));
    assert!(refused.code == 2 && refused.stderr.contains("svg, png, pdf, csv"), "{}", refused.stderr);
}

#[test]
fn regression_shows_the_fingertip_in_clutter() {
    let table = csv(Figure::Regression);
    let registry = Registry::new(&*RESULTS);
    let mut panels = BTreeMap::new();
    for row in 0..table.height() {
        let cell = |column| text(&table, column, row);
        let key = (cell("modality"), cell("experiment"), cell("latent"), cell("index"));
        *panels.entry(key).or_insert(0) += 1;
        if row % 50 > 0 {
            continue;
        }
        let sql = format!(
            "select reference, predicted from predictions where experiment = '{}' and scenario = 'cluttered' and \
             seed = 0 and task = 'prediction' and modality = '{}' and latent = {} and \"index\" = {} and \
             episode = {} and sample = {}",
            cell("experiment"),
            cell("modality"),
            cell("latent"),
            cell("index"),
            cell("episode"),
            cell("sample")
        );
        let found = query(&registry, &sql).unwrap();
        assert_eq!(found.height(), 1, "{sql}");
        for column in ["reference", "predicted"] {
            let (drawn, stored) = (real(&table, column, row).unwrap(), real(&found, column, 0).unwrap());
            assert!((drawn - stored).abs() <= 1e-6 * stored.abs().max(1e-6), "{sql}: {drawn} {stored}");
        }
    }
    // Panels: angle and force, two latent sizes of one experiment and one of the other, two directions. Points: the 29
    // transitions of the test episode.
    assert_eq!(panels.len(), 2 * 3 * 2);
    for ((_, _, _, index), points) in panels {
        assert_eq!(points, 29);
        assert!(["18", "19"].contains(&index.as_str()), "{index}");
    }
}

#[test]
fn diagrams_have_the_layers_of_the_network_that_was_trained() {
    let words = words(Figure::PredictiveArch);
    // The spec has 16 hidden units and 4 channels. The convolution halves the side of 64 pixels.
    for expected in ["32 × 32 × 4", "4 × 4, stride 2", "16", "40", "64 × 64 × 3", "3"] {
        assert!(words.contains(expected), "{expected} is not among {words:?}");
    }
    let count = |figure, prefix: &str| -> f64 {
        let table = csv(figure);
        let rows = (0..table.height()).filter(|row| text(&table, "parameter", *row).starts_with(prefix));
        rows.map(|row| real(&table, "values", row).unwrap()).sum()
    };
    let registry = Registry::new(&*RESULTS);
    let runs = query(&registry, "select parameters from runs where experiment = 'multi_to_multi'").unwrap();
    assert_eq!(count(Figure::PredictiveArch, ""), real(&runs, "parameters", 0).unwrap());
    assert_eq!(count(Figure::PredictiveArch, "encoder"), count(Figure::InformationLossArch, "encoder"));
    assert_ne!(count(Figure::PredictiveArch, "decoder"), count(Figure::InformationLossArch, "decoder"));
}

#[test]
fn forces_and_frames_are_those_of_the_dataset() {
    let results = fresh("figures_frames");
    run(&results, MULTI, &["latent=[4]", "network.channels=[4]", "scenarios=[cluttered]", "seeds=[0]"]);
    let scene = Scene::paper(Scenario::CLUTTERED).unwrap();
    let spec = Simulation { episodes: EPISODES, actuations_per_episode: ACTUATIONS, ..Simulation::default() };
    let dataset = dataset_of(&results.join("datasets"), &scene, &spec);
    let episodes: Vec<_> = (0..EPISODES).map(|index| dataset.read(index, true).unwrap()).collect();
    let run = fs::read_dir(results.join("runs/multi_to_multi")).unwrap().next().unwrap().unwrap().path();

    let forces = TableFile::open(&run.join("forces.parquet")).unwrap().table(None).unwrap();
    // There are two kinds of force on 20 links: first for the whole dataset, then for each episode.
    assert_eq!(forces.height(), 2 * (1 + EPISODES as usize) * 20);
    let whole = (None, &episodes[..]);
    let single = episodes.chunks(1).enumerate().map(|(index, episode)| (Some(index as f64), episode));
    for (block, (index, episodes)) in [whole].into_iter().chain(single).enumerate() {
        for link in 0..20 {
            let row = 20 * block + link;
            assert_eq!(
                (real(&forces, "episode", row), real(&forces, "index", row)),
                (index, Some(link as f64))
            );
            let of_link = |values: &[f32]| -> Vec<f64> {
                values.iter().skip(link).step_by(20).map(|&force| f64::from(force)).collect()
            };
            let values: Vec<f64> =
                episodes.iter().flat_map(|e| of_link(e.vector(Modality::CONTACT_FORCE))).collect();
            assert_eq!(real(&forces, "samples", row), Some(values.len() as f64));
            let touching = values.iter().filter(|force| **force > 0.0).count();
            assert_eq!(real(&forces, "contacts", row), Some(touching as f64));
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            assert!((real(&forces, "mean", row).unwrap() - mean).abs() < 1e-9);
            let max = values.iter().copied().fold(0.0, f64::max);
            assert_eq!(real(&forces, "max", row), (touching > 0).then_some(max));
        }
    }

    let frames = TableFile::open(&run.join("frames.parquet")).unwrap().table(None).unwrap();
    let rows = |task: &str| {
        (0..frames.height()).filter(|row| text(&frames, "task", *row) == task).collect::<Vec<_>>()
    };
    assert_eq!((rows("prediction").len(), rows("reconstruction").len()), (5, 5));
    let bytes =
        |column: &str, row| frames.column(column).unwrap().binary().unwrap().get(row).unwrap().to_vec();
    let frame = |row: usize, back: usize| {
        let (episode, sample) =
            (real(&frames, "episode", row).unwrap(), real(&frames, "sample", row).unwrap());
        let first = (sample as usize - back) * FRAME_LEN;
        &episodes[episode as usize].image(Modality::VISION)[first..first + FRAME_LEN]
    };
    for row in rows("reconstruction") {
        assert!(bytes("reference", row) == frame(row, 0), "the picture is the camera's");
        assert_ne!(bytes("predicted", row), bytes("reference", row));
    }
    let mut motions = Vec::new();
    for row in rows("prediction") {
        let change: Vec<f64> = frame(row, 0)
            .iter()
            .zip(frame(row, 1))
            .map(|(&now, &before)| f64::from(now) - f64::from(before))
            .collect();
        for (byte, change) in bytes("reference", row).iter().zip(&change) {
            assert!((f64::from(*byte) - 128.0 - change / 255.0 * 127.0).abs() <= 0.501);
        }
        let motion = change.iter().map(|change| change.abs() / 255.0).sum::<f64>() / FRAME_LEN as f64;
        assert!((real(&frames, "motion", row).unwrap() - motion).abs() < 1e-6);
        motions.push(motion);
    }
    assert!(motions[0] < motions[4]);
}

#[test]
fn missing_runs_are_named_with_the_command_and_others_are_drawn() {
    let results = fresh("figures_missing");
    run(&results, SINGLE, &["latent=[2]", "scenarios=[cluttered]", "seeds=[0]"]);
    let out = results.join("drawn");
    let figures = |more: &[&str]| {
        let arguments: Vec<&str> =
            ["figures", "--output", out.to_str().unwrap()].iter().chain(more).copied().collect();
        finish(&mut harness(&results, &arguments))
    };
    let all = figures(&[]);
    assert_eq!(all.code, 0, "{}", all.stderr);
    assert_eq!(all.stdout.lines().count(), 3, "{}", all.stdout);
    for name in ["task", "sim_env", "forces_dataset"] {
        assert!(all.stdout.contains(name) && out.join(format!("{name}.svg")).exists(), "{}", all.stdout);
    }
    assert!(all.stderr.contains(" run multi_to_multi`"), "{}", all.stderr);
    assert!(!out.join("regression.svg").exists());

    let named = figures(&["regression"]);
    assert_eq!(named.code, 1);
    assert!(named.stderr.contains("no finished runs of multi_to_multi"), "{}", named.stderr);
    let quick = figures(&["forces_dataset", "--quick"]);
    assert_eq!(quick.code, 1);
    let command = " run single_to_multi --quick`";
    assert!(
        quick.stderr.contains("single_to_multi-quick") && quick.stderr.contains(command),
        "{}",
        quick.stderr
    );
    let other = figures(&["forces_dataset", "--single", "other", "--multi", "single_to_multi"]);
    assert_eq!(other.code, 0, "{}", other.stderr);
    let other = figures(&["regression", "--multi", "other"]);
    let expected = "no finished runs of other; those that have: single_to_multi\n";
    assert!(other.stderr.ends_with(expected), "{}", other.stderr);
    let unknown = figures(&["regresion"]);
    assert_eq!(unknown.code, 2);
    assert!(unknown.stderr.contains("'regression'"), "{}", unknown.stderr);
}

#[test]
fn a_reading_is_drawn_with_its_runs() {
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    let out = fresh("figures_reading");
    let draw = |results: &Path, reading: &str| {
        let arguments = ["prediction_results", "--format", "csv", "--reading", reading];
        let arguments = [&["figures", "--output", out.to_str().unwrap()], &arguments[..]].concat();
        finish(&mut harness(results, &arguments))
    };
    let answer = draw(&reference, "reproduction/recommended");
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let file = fs::File::open(out.join("prediction_results.csv")).unwrap();
    let table = CsvReader::new(file).finish().unwrap();
    let of = |row| (text(&table, "experiment", row), real(&table, "latent", row));
    let networks = (0..table.height()).filter(|row| text(&table, "model", *row) == "network");
    let found: BTreeSet<String> =
        networks.map(of).map(|(experiment, latent)| format!("{experiment} {}", latent.unwrap())).collect();
    let expected = ["16", "2", "4", "64"].map(|latent| format!("reproduction {latent}"));
    assert!(found.is_superset(&expected.into()), "{found:?}");

    // One of the roles has runs with this latent size.
    let sized = ["figures", "prediction_results", "--where", "latent=4", "--output", out.to_str().unwrap()];
    let sized = finish(&mut harness(&reference, &sized));
    let expected = "in the role multi_to_multi with latent=4, and there are others; choose by other settings";
    assert!(sized.stderr.contains(expected) && !sized.stderr.contains("make them"), "{}", sized.stderr);

    for (reading, expected) in [
        ("reproduction/nothing", "reproduction has no reading 'nothing'; its readings are base, recommended"),
        ("base", "'base' names no reading; write EXPERIMENT/READING, for example reproduction/recommended"),
        ("smoke/base", "smoke has no readings; name an experiment that has, such as reproduction"),
        (
            "reproduction/base",
            "no finished runs of reproduction under the reading 'base' in the role single_to_multi; make them with `",
        ),
    ] {
        let answer = draw(&RESULTS, reading);
        assert_ne!(answer.code, 0);
        assert!(answer.stderr.contains(expected), "{}", answer.stderr);
    }
}

#[test]
fn figures_of_any_robot_are_drawn_and_the_others_say_why() {
    let (results, _) = &*crate::report::PENDULUM_PAGE;
    let out = fresh("figures_pendulum");
    let arguments = ["figures", "--experiment", "pendulum", "--output", out.to_str().unwrap()];
    let answer = finish(&mut harness(results, &arguments));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let drawn = [
        Figure::PredictiveArch,
        Figure::ForcesDataset,
        Figure::PredictionResults,
        Figure::PropriovisionToVision,
        Figure::Regression,
    ];
    for figure in Figure::ALL {
        let name = figure.name();
        let is_drawn = drawn.contains(&figure);
        assert_eq!(answer.stdout.contains(&format!("{name} ")), is_drawn, "{name}: {}", answer.stdout);
        // Where nothing has categories, their confusion is not mentioned.
        let is_mentioned = !is_drawn && figure != Figure::Confusion;
        assert_eq!(answer.stderr.contains(&format!("{name} ")), is_mentioned, "{name}: {}", answer.stderr);
        if is_drawn {
            let svg = String::from_utf8(read(&out, figure, "svg")).unwrap();
            assert_whole(&svg, name);
            assert!(!svg.contains("finger"), "{name}");
        }
    }
    for reason in ["the paper's scene", "`harness render` draws any world"] {
        assert!(answer.stderr.contains(reason), "{reason}: {}", answer.stderr);
    }

    // The numbers are those of queries.
    let registry = Registry::new(results);
    let table = |figure: Figure| {
        let path = out.join(format!("{}.csv", figure.name()));
        CsvReader::new(fs::File::open(path).unwrap()).finish().unwrap()
    };
    let forces = table(Figure::ForcesDataset);
    let sql = "select index, max(contacts) as contacts, max(samples) as samples from forces \
               where modality = 'contact_force' and episode is null group by index order by index";
    let expected = query(&registry, sql).unwrap();
    assert_eq!((forces.height(), expected.height()), (2, 2), "the cart and the rod");
    for row in 0..2 {
        let share =
            100.0 * real(&expected, "contacts", row).unwrap() / real(&expected, "samples", row).unwrap();
        assert!((real(&forces, "contact_percent", row).unwrap() - share).abs() < 1e-9, "{row}");
    }
    let points = table(Figure::Regression);
    let sql = "select predicted from predictions where modality = 'contact_force' and index = 1 and seed = 0 \
               and latent = 4 order by episode, sample";
    let stored = query(&registry, sql).unwrap();
    let is_of =
        |row: &usize| real(&points, "latent", *row) == Some(4.0) && real(&points, "index", *row) == Some(1.0);
    let shown: Vec<f64> =
        (0..points.height()).filter(is_of).filter_map(|row| real(&points, "predicted", row)).collect();
    assert_eq!(shown.len(), stored.height());
    for (row, shown) in shown.iter().enumerate() {
        // The CSV file has the digits that tell numbers of single precision apart.
        let stored = real(&stored, "predicted", row).unwrap();
        assert!((shown - stored).abs() <= 1e-6 * stored.abs(), "{row}: {shown} {stored}");
    }
    let unknown = finish(&mut harness(results, &["figures", "--experiment", "pendulm"]));
    assert!(
        unknown.code != 0 && unknown.stderr.contains("'pendulm' has no finished runs"),
        "{}",
        unknown.stderr
    );
}

#[test]
fn figures_of_an_ablation_show_the_data_or_one_variant() {
    let (results, _) = &*crate::report::ABLATION_PAGE;
    let out = fresh("figures_ablation");
    let arguments = ["figures", "--experiment", "ablation", "--output", out.to_str().unwrap()];
    let answer = finish(&mut harness(results, &arguments));
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    let svg = |figure: Figure| String::from_utf8(read(&out, figure, "svg")).unwrap();
    for (figure, is_of_one) in [
        (Figure::PredictiveArch, true),
        (Figure::ForcesDataset, false),
        (Figure::PredictionResults, false),
        (Figure::PropriovisionToVision, true),
        (Figure::Regression, true),
    ] {
        let svg = svg(figure);
        assert_whole(&svg, figure.name());
        let remark = "only the first of 3 variants: joints";
        assert_eq!(svg.contains(remark), is_of_one, "{}", figure.name());
    }
    // The inputs are beside each other, in the order of the spec.
    let names = ["joints", "joints + side", "side"];
    let drawn = svg(Figure::PredictionResults);
    let places = names.map(|name| drawn.find(&format!("aria-label=\"{name}\"")).unwrap());
    assert!(places.is_sorted(), "{places:?}");
}

#[test]
fn one_seed_has_no_bars_and_other_settings_are_refused() {
    let results = fresh("figures_seeds");
    let draw = |name: &str, more: &[&str]| {
        let out = results.join(name);
        let arguments = ["figures", "reconstruction_performance", "--output", out.to_str().unwrap()];
        let answer = finish(&mut harness(&results, &[&arguments[..], more].concat()));
        (answer, fs::read_to_string(out.join("reconstruction_performance.svg")).unwrap_or_default())
    };
    for (spec, more) in [(SINGLE, "network.hidden=32"), (MULTI, "network.channels=[4]")] {
        run(&results, spec, &["latent=[2,4]", "scenarios=[empty]", "seeds=[0]", more]);
    }
    let (_, one) = draw("one", &[]);
    assert!(one.contains("one seed, no bars"));
    // Runs with other settings can't be averaged with these, so the figure is refused.
    let more = ["network.hidden=32", "training.learning_rate=0.01"];
    run(&results, SINGLE, &[&["latent=[2]", "scenarios=[empty]", "seeds=[1]"][..], &more].concat());
    let (answer, drawn) = draw("other", &[]);
    assert_eq!((answer.code, drawn.as_str()), (1, ""));
    let choice = "single_to_multi:training.learning_rate=0.001";
    let expected = format!(
        "the runs of single_to_multi differ in training.learning_rate (0.001, 0.01); select some, for example with \
         `--where '{choice}'`\n"
    );
    assert!(answer.stderr.ends_with(&expected), "{}", answer.stderr);
    let (answer, drawn) = draw("chosen", &["--where", choice]);
    assert!(answer.code == 0 && drawn == one, "{}", answer.stderr);
    // Missing runs with a setting are listed with the command that makes them.
    let (answer, _) = draw("none", &["--where", "training.learning_rate=0.01"]);
    let expected = " run multi_to_multi 'training.learning_rate=0.01'`";
    assert!(answer.code == 1 && answer.stderr.contains(expected), "{}", answer.stderr);
    for (setting, expected) in [
        (
            "learning_rate=0.01",
            "no run has a setting 'learning_rate'; did you mean 'training.learning_rate'?",
        ),
        ("nonsense=1", "no run has a setting 'nonsense'; use a key of the spec, such as training.batch_size"),
        (
            "training.learning_rate=1",
            "no finished run has training.learning_rate=1; finished runs have training.learning_rate ",
        ),
        ("training", "'training' is not a setting; write KEY=VALUE, such as training.batch_size=64"),
    ] {
        let (answer, _) = draw("refused", &["--where", setting]);
        assert!(answer.code == 2 && answer.stderr.contains(expected), "{}", answer.stderr);
    }
}

#[test]
fn text_is_as_wide_as_the_font_says() {
    // The advance widths of Roboto, read with fonttools, in units of 1/2048 em: H 1461, i 498, 0 1151.
    let how = Type { size: 10.0, ..Type::LABEL };
    assert!((how.width("Hi0") - 10.0 * (1461.0 + 498.0 + 1151.0) / 2048.0).abs() < 1e-9);
    // A subscript is smaller, and markup has no width.
    assert!(how.width("H_{0}") < how.width("H0") && how.width("H_{0}") > how.width("H"));
    let mut page = Page::new(100.0, 20.0, "A & B < C");
    page.text("5 < 6 & \"7\"", [50.0, 15.0], Type { anchor: Anchor::Middle, ..how });
    page.line([0.0, 1.0], [100.0, 1.0], Stroke::new("#000000", 1.0));
    let svg = page.svg();
    let document = roxmltree::Document::parse(&svg).unwrap();
    let labels: Vec<_> = document.descendants().filter_map(|node| node.attribute("aria-label")).collect();
    assert_eq!(labels, ["A & B < C", "5 < 6 & \"7\""]);
}
