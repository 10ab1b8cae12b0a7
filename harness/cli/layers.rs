//! Tables of network layers, for `harness show` and `harness run --dry-run`.

use anyhow::Result;
use harness::learning::network::{architecture, description::Layer};
use harness::spec::{Layout, RunSpec, Task};
use std::sync::Arc;

/// A table of the layers that a run trains: name, shape of the output for one sample, and number of parameters. After
/// the layers of each task follows the total number of its parameters. It is empty for an external model.
pub fn table(spec: &RunSpec, layout: &Arc<Layout>) -> Result<String> {
    let mut lines = vec![["layer".to_owned(), "output".to_owned(), "parameters".to_owned()]];
    let Some(trained) = spec.trained() else { return Ok(String::new()) };
    for &task in &spec.tasks {
        let summary = architecture(spec, trained, layout, task).summary()?;
        // The reconstruction uses the trained encoder of the prediction, which is frozen.
        let parts = match task {
            Task::Prediction => {
                vec![("encoder", summary.encoder), ("memory", summary.memory), ("decoder", summary.decoder)]
            }
            Task::Reconstruction => vec![("reconstruction", summary.decoder)],
        };
        let layers = || parts.iter().flat_map(|(_, layers)| layers);
        let parameters: usize = layers().map(|layer| layer.parameters).sum();
        for (part, layers) in &parts {
            lines.extend(layers.iter().map(|layer| line(part, layer)));
        }
        lines.push([format!("{task} in all"), String::new(), parameters.to_string()]);
    }
    let widths =
        [0, 1, 2].map(|column| lines.iter().map(|line| line[column].len()).max().unwrap_or_default());
    let shown = lines.iter().map(|[layer, output, parameters]| {
        format!("{layer:<0$}  {output:<1$}  {parameters:>2$}", widths[0], widths[1], widths[2])
    });
    Ok(shown.collect::<Vec<_>>().join("\n"))
}

fn line(part: &str, layer: &Layer) -> [String; 3] {
    let shape: Vec<String> = layer.output.iter().map(usize::to_string).collect();
    [format!("{part}.{}", layer.name), shape.join(" x "), layer.parameters.to_string()]
}
