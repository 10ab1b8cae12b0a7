//! How bodies stand on the ground: the shapes of the bodies that episodes place, and the fixed surfaces below them.

use mujoco_rs::prelude::*;
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// Number of corners of the polygon that contains a cylinder's circle.
const CORNERS: usize = 16;

/// A body that episodes place, with a free joint.
#[derive(Debug, Clone)]
pub(super) struct FreeBody {
    /// Index into `qpos` of its position (3 values) and orientation (4).
    pub qpos: usize,
    /// Index in the model.
    pub body: usize,
    /// Orientation in the model. It is the identity if the body is only turned about the vertical axis, because each
    /// episode draws that angle.
    pub tilt: [f64; 4],
    shapes: Vec<Shape>,
    /// Height of its origin in the model, m.
    height: f64,
}

/// A geom as points, each with a ball around it. Coordinates are relative to the body's origin, along the axes of the
/// world if the body has its tilt and no yaw, m.
#[derive(Debug, Clone)]
struct Shape {
    geom: usize,
    center: [f64; 3],
    /// Relative to the center.
    points: Vec<[f64; 3]>,
    ball: f64,
}

impl FreeBody {
    /// Reads the shape of a body with a free joint. The error says what is wrong with the body.
    pub fn new(model: &MjModel, body: usize) -> Result<Self, &'static str> {
        let joint = usize::try_from(model.body_jntadr()[body]).ok();
        let joint = joint.filter(|joint| model.jnt_type()[*joint] == MjtJoint::mjJNT_FREE);
        let Some(joint) = joint else { return Err("must have a free joint") };
        let qpos = model.jnt_qposadr()[joint] as usize;
        let own = &model.qpos0()[qpos..qpos + 7];
        let tilt = match own {
            [.., x, y, _] if (*x, *y) == (0.0, 0.0) => [1.0, 0.0, 0.0, 0.0],
            [.., w, x, y, z] => [*w, *x, *y, *z],
            _ => [1.0, 0.0, 0.0, 0.0],
        };
        let height = own[2];
        let mut data = MjData::new(model);
        data.qpos_mut()[qpos..qpos + 3].fill(0.0);
        data.qpos_mut()[qpos + 3..qpos + 7].copy_from_slice(&tilt);
        data.kinematics();
        let is_own = |geom: &usize| model.body_rootid()[model.geom_bodyid()[*geom] as usize] as usize == body;
        let geoms = (0..model.ngeom() as usize).filter(is_own).filter(|geom| can_touch(model, *geom));
        let shape = |geom: usize| {
            let turn = data.geom_xmat()[geom];
            let (points, ball) = outline(model, geom);
            let turned = |[x, y, z]: [f64; 3]| {
                [0, 3, 6].map(|row| turn[row] * x + turn[row + 1] * y + turn[row + 2] * z)
            };
            let points = points.into_iter().map(turned).collect();
            Shape { geom, center: data.geom_xpos()[geom], points, ball }
        };
        let shapes: Vec<Shape> = geoms.map(shape).collect();
        if shapes.is_empty() {
            return Err("has no geom that can touch anything, so it can't stand on the ground");
        }
        Ok(Self { qpos, body, tilt, shapes, height })
    }

    /// Returns the radius of the vertical cylinder about the body's origin that contains it, m. `scale` is the number
    /// by which a geom's size is multiplied.
    pub fn radius(&self, scale: impl Fn(usize) -> f64) -> f64 {
        let of_shape = |shape: &Shape| {
            let (scale, [x, y, _]) = (scale(shape.geom), shape.center);
            let away = |point: &[f64; 3]| (x + scale * point[0]).hypot(y + scale * point[1]);
            shape.points.iter().map(away).fold(0.0, f64::max) + scale * shape.ball
        };
        self.shapes.iter().map(of_shape).fold(0.0, f64::max)
    }

    /// Returns the heights of its lowest and highest point above the body's origin, m.
    fn span(&self, scale: impl Fn(usize) -> f64) -> [f64; 2] {
        let mut span = [f64::INFINITY, f64::NEG_INFINITY];
        for shape in &self.shapes {
            let scale = scale(shape.geom);
            for point in &shape.points {
                let middle = shape.center[2] + scale * point[2];
                span = [span[0].min(middle - scale * shape.ball), span[1].max(middle + scale * shape.ball)];
            }
        }
        span
    }

    /// Returns the height of the body's origin if it stands on the ground at this place, m. With no fixed surface
    /// there, it is the body's height in the model. `scale` is that of [`FreeBody::radius`].
    pub fn stand(&self, ground: &mut Ground, place: [f64; 2], scale: impl Fn(usize) -> f64) -> f64 {
        let [low, high] = self.span(|_| 1.0);
        let middle = self.height + 0.5 * (low + high);
        match ground.height(place, self.radius(&scale), middle) {
            Some(surface) => surface - self.span(scale)[0],
            None => self.height,
        }
    }
}

/// Whether a geom can touch anything. Others are only seen.
pub(super) fn can_touch(model: &MjModel, geom: usize) -> bool {
    let pairs = model.pair_geom1().iter().chain(model.pair_geom2());
    model.geom_contype()[geom] != 0
        || model.geom_conaffinity()[geom] != 0
        || pairs.into_iter().any(|own| *own as usize == geom)
}

/// Returns points in a geom's own frame, and the radius of the ball around each, that together contain the geom, m.
fn outline(model: &MjModel, geom: usize) -> (Vec<[f64; 3]>, f64) {
    let [x, y, z] = model.geom_size()[geom];
    match model.geom_type()[geom] {
        MjtGeomBase::mjGEOM_SPHERE => (vec![[0.0; 3]], x),
        MjtGeomBase::mjGEOM_CAPSULE => (vec![[0.0, 0.0, -y], [0.0, 0.0, y]], x),
        MjtGeomBase::mjGEOM_CYLINDER => {
            let radius = x / (PI / CORNERS as f64).cos();
            let corner = |index: usize| {
                let (sin, cos) = (TAU * index as f64 / CORNERS as f64).sin_cos();
                [-y, y].map(|height| [radius * cos, radius * sin, height])
            };
            ((0..CORNERS).flat_map(corner).collect(), 0.0)
        }
        MjtGeomBase::mjGEOM_BOX | MjtGeomBase::mjGEOM_ELLIPSOID => (corners([0.0; 3], [x, y, z]), 0.0),
        MjtGeomBase::mjGEOM_MESH => {
            let mesh = model.geom_dataid()[geom] as usize;
            let first = model.mesh_vertadr()[mesh] as usize;
            let vertices = &model.mesh_vert()[first..first + model.mesh_vertnum()[mesh] as usize];
            (vertices.iter().map(|vertex| vertex.map(f64::from)).collect(), 0.0)
        }
        _ => {
            let [cx, cy, cz, x, y, z] = model.geom_aabb()[geom];
            (corners([cx, cy, cz], [x, y, z]), 0.0)
        }
    }
}

/// Returns the corners of a box.
fn corners(center: [f64; 3], half: [f64; 3]) -> Vec<[f64; 3]> {
    let sign = |corner: usize, axis: usize| if corner >> axis & 1 == 0 { -1.0 } else { 1.0 };
    let corner = |corner| std::array::from_fn(|axis| center[axis] + sign(corner, axis) * half[axis]);
    (0..8).map(corner).collect()
}

/// The surfaces of a model that can't move.
#[derive(Debug)]
pub(super) struct GroundModel {
    /// A copy of the model in which their geoms are in group 0, and all others in group 1.
    model: Arc<MjModel>,
    /// A height above all of them, m.
    top: f64,
}

/// Finds the height of the ground.
pub(super) struct Ground {
    data: MjData<Arc<MjModel>>,
    top: f64,
}

impl GroundModel {
    pub fn new(model: &MjModel) -> Self {
        let mut copy = Box::new(model.clone());
        let mut data = MjData::new(model);
        data.kinematics();
        let mut top: f64 = 0.0;
        for geom in 0..model.ngeom() as usize {
            let is_fixed = is_fixed(model, geom) && can_touch(model, geom);
            copy.geom_group_mut()[geom] = i32::from(!is_fixed);
            if is_fixed {
                // Rays don't see transparent geoms, and see only the drawn part of a plane.
                copy.geom_rgba_mut()[geom][3] = 1.0;
                if model.geom_type()[geom] == MjtGeomBase::mjGEOM_PLANE {
                    copy.geom_size_mut()[geom] = [0.0; 3];
                }
                top = top.max(data.geom_xpos()[geom][2] + model.geom_rbound()[geom]);
            }
        }
        Self { model: Arc::from(copy), top: top + 1.0 }
    }

    pub fn ground(&self) -> Ground {
        let mut data = MjData::new(self.model.clone());
        data.kinematics();
        Ground { data, top: self.top }
    }
}

/// Whether a geom belongs to the world or to a body that can't move in it.
fn is_fixed(model: &MjModel, geom: usize) -> bool {
    model.body_weldid()[model.geom_bodyid()[geom] as usize] == 0
}

impl Ground {
    /// Returns the height of the highest surface below a disc, m. Surfaces above the height `from` count only if there
    /// is none below it. `None` if there is none at all.
    fn height(&mut self, [x, y]: [f64; 2], radius: f64, from: f64) -> Option<f64> {
        let around = (0..8).map(|eighth| {
            let (sin, cos) = (TAU * f64::from(eighth) / 8.0).sin_cos();
            [x + radius * cos, y + radius * sin]
        });
        let points: Vec<[f64; 2]> = std::iter::once([x, y]).chain(around).collect();
        [from, self.top.max(from)].into_iter().find_map(|from| {
            let surfaces = points.iter().filter_map(|[x, y]| self.below([*x, *y, from]));
            surfaces.reduce(f64::max)
        })
    }

    /// Returns the height of the first surface below a point, m.
    fn below(&mut self, point: [f64; 3]) -> Option<f64> {
        let groups = [1, 0, 0, 0, 0, 0];
        let (geom, distance) = self.data.ray(&point, &[0.0, 0.0, -1.0], Some(&groups), true, None, None);
        geom.map(|_| point[2] - distance)
    }
}
