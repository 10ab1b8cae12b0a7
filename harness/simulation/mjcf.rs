//! A scene's model as one MJCF file, from which people see what differs between two models.

use super::Scene;
use super::scene::{digest, prepare, stands_alone};
use harness_spec::ModelFile;
use mujoco_rs::prelude::*;

impl Scene {
    /// Returns the model as MJCF with the files that it includes. For each mesh, height field and texture, a text
    /// element has the first digits of the SHA-256 of the content, which is not part of the MJCF. `None` if MuJoCo
    /// can't write the model, or its files have changed since it was compiled.
    pub fn mjcf(&self) -> Option<String> {
        prepare().ok()?;
        let mut spec = match self.world().model() {
            ModelFile::File(_) if !stands_alone(self.xml()) && self.has_changed() => return None,
            ModelFile::File(path) if !stands_alone(self.xml()) => MjSpec::from_xml(path),
            _ => MjSpec::from_xml_string(self.xml()),
        }
        .ok()?;
        spec.compile().ok()?;
        let Err(MjEditError::XmlBufferTooSmall { required_size }) = spec.save_xml_string(1) else {
            return None;
        };
        let xml = spec.save_xml_string(required_size + 1).ok()?;
        let contents: String = self.contents().map(|content| format!("    {content}\n")).collect();
        match xml.rsplit_once("</mujoco>") {
            Some((xml, _)) if !contents.is_empty() => {
                Some(format!("{xml}  <custom>\n{contents}  </custom>\n</mujoco>\n"))
            }
            _ => Some(xml),
        }
    }

    /// Returns a text element for each mesh, height field and texture of the compiled model.
    fn contents(&self) -> impl Iterator<Item = String> {
        let model = self.model();
        let bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let mesh = move |mesh: usize| {
            let first = model.mesh_vertadr()[mesh] as usize;
            bytes(model.mesh_vert()[first..first + model.mesh_vertnum()[mesh] as usize].as_flattened())
        };
        let field = move |field: usize| {
            let (first, rows) = (model.hfield_adr()[field] as usize, model.hfield_nrow()[field] as usize);
            bytes(&model.hfield_data()[first..first + rows * model.hfield_ncol()[field] as usize])
        };
        let texture = move |texture: usize| model.load_texture(texture).unwrap_or_default().into_owned();
        let meshes =
            (0..model.nmesh() as usize).map(move |id| (MjtObjBase::mjOBJ_MESH, "mesh", id, mesh(id)));
        let fields =
            (0..model.nhfield() as usize).map(move |id| (MjtObjBase::mjOBJ_HFIELD, "hfield", id, field(id)));
        let textures =
            (0..model.ntex() as usize).map(move |id| (MjtObjBase::mjOBJ_TEXTURE, "texture", id, texture(id)));
        meshes.chain(fields).chain(textures).map(move |(kind, word, id, content)| {
            let name = model.id_to_name(kind, id).filter(|name| !name.is_empty());
            let name = name.map_or_else(|| id.to_string(), escaped);
            format!("<text name=\"sha256 of {word} {name}\" data=\"{}\"/>", &digest(&content)[..16])
        })
    }
}

/// A text that can be an attribute of XML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}
