//! `harness plot` on real runs.

use crate::common::{SMOKE, finish, fresh, harness, succeed};
use std::path::PathBuf;
use std::sync::LazyLock;

/// Runs of two latent sizes with two seeds each, in both scenarios.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| {
    let results = fresh("plot");
    succeed(&results, &["run", SMOKE, "seeds=[0,1]", "latent=[2,4]"]);
    results
});

#[test]
fn a_plot_is_the_same_each_time_it_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let plot = |name: &str| {
        let asked =
            ["plot", "smoke", "--x", "latent", "--metrics", "r2", "--by", "modality", "--facet", "scenario"];
        succeed(&RESULTS, &[&asked[..], &["--output", &path(name)]].concat())
    };
    assert_eq!(plot("plot.csv"), format!("8 means in {}\n", path("plot.csv")));
    let read = |name: &str| std::fs::read_to_string(path(name)).unwrap();
    let one = ["--where", "scenario=empty", "--where", "latent=2", "--output", &path("one.csv")];
    let asked = ["plot", "smoke", "--x", "latent", "--metrics", "relative_error"];
    let said = succeed(&RESULTS, &[&asked[..], &one].concat());
    assert_eq!(said, format!("1 mean in {}\n", path("one.csv")));

    plot("plot.svg");
    plot("again.svg");
    let svg = read("plot.svg");
    assert_eq!(svg, read("again.svg"));
    assert!(svg.contains("<title>R2 over latent</title>"), "{}", &svg[..500]);
    for text in ["empty", "cluttered", "contact_force", "proprioception", "latent", "R2"] {
        assert!(svg.contains(&format!("aria-label=\"{text}\"")) || svg.contains(text), "no {text}");
    }
    plot("plot.png");
    let (width, height) = image::image_dimensions(path("plot.png")).unwrap();
    assert!(width > 1900 && height > 900, "{width} x {height}");
}

#[test]
fn baselines_are_plotted_beside_the_networks() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let models = ["--models", "network,persistence,ridge,training_mean"];
    let plot = |name: &str| {
        let asked =
            ["plot", "smoke", "--x", "latent", "--metrics", "r2", "--by", "modality", "--facet", "scenario"];
        succeed(&RESULTS, &[&asked[..], &models, &["--output", &path(name)]].concat())
    };
    // Two scenarios and two modalities: 8 means of networks, and one of each of the three baselines.
    assert_eq!(plot("plot.csv"), format!("20 means in {}\n", path("plot.csv")));
    let compared = path("compare.csv");
    let asked = ["compare", "smoke", "--metrics", "r2", "--task", "prediction", "--output", &compared];
    succeed(&RESULTS, &[&asked[..], &models].concat());
    let read = |name: &str| std::fs::read_to_string(path(name)).unwrap();
    assert_eq!(read("plot.csv"), read("compare.csv"));

    plot("plot.svg");
    let svg = read("plot.svg");
    for name in ["contact_force", "contact_force, persistence", "proprioception, ridge"] {
        assert!(svg.contains(&format!("aria-label=\"{name}\"")), "no {name}");
    }
    assert!(svg.contains("contact_force, training mean"));
    // Each of six series of baselines has a dashed line in both panels and one in the legend. Ridge regression's R2 of
    // the joint angles in `cluttered` lies far below all others.
    assert_eq!(svg.matches("stroke-dasharray").count(), 18 - 1);
    assert!(svg.contains("beyond the axis: proprioception, ridge, cluttered: \u{2212}"));
}

#[test]
fn only_points_along_numbers_are_connected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plot.svg").display().to_string();
    let dashes = |x: &str, facet: &str| {
        let asked = ["plot", "smoke", "--x", x, "--facet", facet, "--metrics", "r2", "--by", "modality"];
        succeed(&RESULTS, &[&asked[..], &["--models", "network,persistence", "--output", &path]].concat());
        std::fs::read_to_string(&path).unwrap().matches("stroke-dasharray").count()
    };
    // The dashed lines of persistence, in two panels and in the legend.
    assert_eq!(dashes("latent", "scenario"), 2 * (2 + 1));
    assert_eq!(dashes("scenario", "latent"), 0);
}

#[test]
fn panels_by_task_show_both_tasks() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let tasks = |more: &[&str]| {
        let asked = ["plot", "smoke", "--x", "latent", "--metrics", "r2", "--by", "modality", "--where"];
        let rest = ["scenario=empty", "--output", &path("plot.csv")];
        succeed(&RESULTS, &[&asked[..], &rest, more].concat());
        let table = std::fs::read_to_string(path("plot.csv")).unwrap();
        ["prediction", "reconstruction"].map(|task| table.contains(&format!(",{task},")))
    };
    assert_eq!(tasks(&["--facet", "task"]), [true, true]);
    assert_eq!(tasks(&[]), [true, false]);
    assert_eq!(tasks(&["--facet", "task", "--task", "reconstruction"]), [false, true]);
}

#[test]
fn metrics_stand_side_by_side() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("plot.csv").display().to_string();
    let asked = [
        "plot",
        "--x",
        "metric",
        "--metrics",
        "rmse,mae",
        "--by",
        "scenario,latent",
        "--of",
        "contact_force",
    ];
    succeed(&RESULTS, &[&asked[..], &["--output", &output]].concat());
    let table = std::fs::read_to_string(&output).unwrap();
    assert!(table.contains(",rmse,") && table.contains(",mae,"), "{table}");
    let output = folder.path().join("plot.svg").display().to_string();
    succeed(&RESULTS, &[&asked[..], &["--output", &output]].concat());
    let drawn = std::fs::read_to_string(&output).unwrap();
    assert!(["rmse", "mae", "contact force, N", "metric"].iter().all(|word| drawn.contains(word)), "{drawn}");
}

#[test]
fn a_plot_that_cannot_be_drawn_says_what_to_do() {
    let asked = ["plot", "--x", "latent", "--metrics", "r2"];
    let refused = |more: &[&str]| {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("plot.svg").display().to_string();
        let answer = finish(&mut harness(&RESULTS, &[&asked[..], more, &["--output", &output]].concat()));
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""), "{more:?}");
        assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "{more:?}");
        answer.stderr
    };
    let ambiguous = refused(&["--facet", "scenario"]);
    let expected =
        "error: the means differ in modality: contact_force; proprioception; distinguish them with --by or ";
    assert!(ambiguous.starts_with(expected), "{ambiguous}");
    let unknown = refused(&["--by", "varient"]);
    assert!(unknown.contains("variant") && unknown.contains("modality"), "{unknown}");
    let missing = refused(&["--of", "vision"]);
    assert!(missing.contains("no run has these metrics for this task"), "{missing}");
    for (option, several, expected) in [
        ("--metrics", "rmse", "a plot shows one metric; choose one of r2, rmse with --metrics"),
        ("--horizon", "1,5", "no run predicts 5 samples ahead; the runs predict 1 sample ahead"),
        ("--horizon", "0.5s", "no run predicts 0.5 s ahead"),
        ("--models", "network,", "a list has no spaces and no comma at its end"),
        ("--by", "scenario,", "a list has no spaces and no comma at its end"),
    ] {
        let refusal = refused(&[option, several]);
        assert!(refusal.contains(expected), "{refusal}");
    }
    let ending = finish(&mut harness(&RESULTS, &[&asked[..], &["--output", "plot.eps"]].concat()));
    assert!(ending.stderr.contains("must end in .svg, .png, .pdf or .csv"), "{}", ending.stderr);
}
