use super::Session;
use super::engine::Engine;
use super::imaging::Imaging;
use crate::RehearseError;
use crate::motion::RigidPose;
use crate::output::{PointCloud, VtuArray};
use crate::render::{Camera, FrameText, GreyImage, Mesh, Picture, SceneGeometry, draw_frame};
use crate::scene::Cut;
use crate::trace::{StepRow, UNCALIBRATED_SHORT};
use glam::{DVec3, Vec3};
use palpate_ultrasound::Level;

impl Session {
    /// The view of the whole session: organ at rest, supports, instruments where they start. Looks from the scene's `view.from`,
    /// else aslant: from the organ's side and somewhat from above, gravity down.
    pub fn camera(&self) -> Camera {
        let view = &self.scene.view;
        let (width, height) = (view.width_px as usize, view.height_px as usize);
        // The view takes a square at the left, or as much as leaves a panel.
        let across = height.min(width * 9 / 16);
        let mut up = -self.scene.gravity.direction.unit().as_vec3();
        // Gravity runs down the picture; an instrument's image plane lies as nearly in the picture as can be.
        let side = match self.tools.first() {
            Some(t) => (t.start.rotation * DVec3::Y).as_vec3(),
            None => up.any_orthonormal_vector(),
        };
        let side = (side - up * side.dot(up)).normalize_or(up.any_orthonormal_vector());
        let mut toward = (side + up * 0.42 + up.cross(side) * 0.28).normalize_or(Vec3::Z);
        if let Some(from) = view.from {
            toward = from.unit().as_vec3();
        }
        let way = match &self.engine {
            Engine::Tissue(t) => t.first_way(),
            _ => None,
        };
        if let (Some(Cut::Needle), Some((_, along, side, _))) = (view.cut, way) {
            let across = along.cross(side).as_vec3().normalize_or(Vec3::Z);
            toward = across * if across.dot(toward) < 0.0 { -1.0 } else { 1.0 };
        }
        if up.cross(toward).length() < 1e-3 {
            up = Vec3::Z;
        }
        let tools: Vec<Mesh> = self.tools.iter().map(|t| placed(&t.mesh, t.start)).collect();
        let points = self
            .organs
            .iter()
            .flat_map(|o| &o.surface.mesh.vertices)
            .chain(tools.iter().flat_map(|m| &m.vertices))
            .copied()
            .chain(self.needle_meshes(0.5).into_iter().flat_map(|n| n.1.vertices));
        let mut out = Camera::framing(points, toward, up, across, height);
        // Room for the support around the organ.
        out.px_per_mm *= 0.9;
        if let Some(span) = view.span_mm {
            out.px_per_mm = across.min(height) as f32 / span as f32;
            if let Some((start, _, _, Some(target))) = way {
                out.centre = (0.5 * (start + target)).as_vec3();
            }
        }
        out
    }

    /// Where the view is cut, mm towards the viewer from the camera's centre.
    fn cut_mm(&self, camera: &Camera) -> Option<f32> {
        let Engine::Tissue(t) = &self.engine else {
            return None;
        };
        self.scene.view.cut?;
        let (start, ..) = t.first_way()?;
        Some((start.as_vec3() - camera.centre).dot(camera.toward))
    }

    /// The picture after the last step: the view at the left, the ultrasound image and the figures beside it.
    ///
    /// # Errors
    /// A GPU that was lost.
    pub fn picture(&mut self, camera: &Camera) -> Result<Picture, RehearseError> {
        self.read_back()?;
        for organ in &mut self.organs {
            organ.surface.shade();
            organ.structures.iter_mut().for_each(|s| s.shade());
        }
        let scene = SceneGeometry {
            organs: self.organs.iter().map(|o| &o.surface.mesh).collect(),
            structures: self
                .organs
                .iter()
                .flat_map(|o| o.structures.iter().map(|s| &s.mesh))
                .collect(),
            supports: self.supports.iter().collect(),
            instruments: self.tools.iter().map(|t| placed(&t.mesh, t.now)).collect(),
            // No thinner than shows.
            needles: self
                .needle_meshes(0.7f32.min(2.5 / camera.px_per_mm))
                .into_iter()
                .map(|n| n.1)
                .collect(),
            targets: self.targets(),
            fiducials: &self.organs[0].fiducials.points,
            plane: self.imaging.as_ref().map(|i| self.plane(i)),
            cut_mm: self.cut_mm(camera),
        };
        let view = &self.scene.view;
        let image = self.cropped();
        Ok(draw_frame(
            &scene,
            camera,
            view.organ_opacity as f32,
            image.as_ref().map(CroppedImage::borrow),
            &self.text(),
            view.width_px as usize,
            view.height_px as usize,
        ))
    }

    /// The ultrasound image after the last step within the transducer's field of view; none where the scene asks for none.
    ///
    /// # Errors
    /// A GPU that was lost.
    pub fn image(&mut self) -> Result<Option<CroppedImage>, RehearseError> {
        self.read_back()?;
        Ok(self.cropped())
    }

    fn cropped(&self) -> Option<CroppedImage> {
        let imaging = self.imaging.as_ref()?;
        let whole = imaging.scanner.held()?;
        let grid = imaging.scanner.grid();
        let probe = imaging.scanner.probe();
        let centre = |column: usize| grid.plane([column as f64, 0.0])[0];
        let half = probe.plane(0.0, 0.0)[0]
            .abs()
            .max(probe.plane(0.0, probe.depth_mm)[0].abs())
            + 0.5 * grid.pixel_mm;
        let inside: Vec<usize> = (0..grid.width_px).filter(|&c| centre(c).abs() <= half).collect();
        let (first, width) = (inside.first().copied()?, inside.len());
        let grey = whole
            .pixels()
            .chunks_exact(grid.width_px)
            .flat_map(|row| &row[first..first + width])
            .copied()
            .collect();
        Some(CroppedImage {
            width,
            height: grid.height_px,
            grey,
            width_mm: width as f64 * grid.pixel_mm,
            depth_mm: grid.height_px as f64 * grid.pixel_mm,
        })
    }

    fn plane(&self, imaging: &Imaging) -> [Vec3; 4] {
        let probe = imaging.scanner.probe();
        let pose = self.tools[imaging.tool].now;
        let last = probe.lines as f64 - 1.0;
        [
            (0.0, 0.0),
            (last, 0.0),
            (last, probe.depth_mm),
            (0.0, probe.depth_mm),
        ]
        .map(|(line, depth)| {
            let [x, z] = probe.plane(line, depth);
            pose.apply(DVec3::new(x, 0.0, z)).as_vec3()
        })
    }

    fn text(&self) -> FrameText {
        let mut out = FrameText {
            title: self.scene.name.clone(),
            image: match &self.imaging {
                Some(i) => format!(
                    "{}: {}",
                    self.tools[i.tool].name,
                    level_name(
                        i.scanner.settings().level,
                        i.scanner.organs().iter().any(|o| o.is_nominal())
                    )
                ),
                None => String::new(),
            },
            ..FrameText::default()
        };
        let Some(row) = self.trace.steps.last() else {
            return out;
        };
        let stage = self.trace.stages.get(row.stage).map_or("", |s| s.name.as_str());
        out.lines.push(format!("t {:5.2} s  {stage}", row.time_s));
        if self.scene.press.is_some() {
            out.lines
                .push(format!("indentation {:5.2} mm", row.indentation_mm));
        }
        out.lines.extend(self.felt(row));
        for (info, n) in self.trace.needles.iter().zip(&row.needles).take(2) {
            let miss = n
                .miss_mm()
                .map_or_else(String::new, |m| format!(", target {m:4.1} mm"));
            out.lines.push(format!(
                "{} {:5.2} N, {:4.1} mm deep{miss}",
                info.name, n.base_axial_n, n.inside_mm
            ));
        }
        if !self.tools.is_empty() || !row.needles.is_empty() {
            out.caution = UNCALIBRATED_SHORT.into();
        }
        out
    }

    fn felt(&self, row: &StepRow) -> Vec<String> {
        self.tools
            .iter()
            .zip(&row.contacts)
            .take(2)
            .map(|(t, c)| {
                format!(
                    "{} {:5.2} N, {:4.0} mm², {:5.2} kPa",
                    t.name,
                    c.force(),
                    c.area_mm2,
                    c.pressure_kpa
                )
            })
            .collect()
    }

    /// The deformed surfaces of organs and structures in patient mm, with the displacement from rest. On a GPU those of the
    /// last [`Session::read_back`].
    pub fn surface_clouds(&self, rest: &RestShape) -> Vec<(String, PointCloud<'_>)> {
        let mut out = Vec::new();
        for (organ, at_rest) in self.organs.iter().zip(&rest.surfaces) {
            for (mesh, from) in organ.meshes().zip(at_rest) {
                let name = if mesh.name == organ.surface.name {
                    organ.name.clone()
                } else {
                    format!("{}-{}", organ.name, mesh.name)
                };
                let moved = displacement(&mesh.mesh.vertices, from);
                out.push((
                    name,
                    PointCloud {
                        points_mm: super::patient(&mesh.mesh.vertices, self.origin),
                        triangles: &mesh.mesh.triangles,
                        arrays: vec![VtuArray::Vectors("displacement_mm".into(), moved)],
                        ..PointCloud::default()
                    },
                ));
            }
        }
        out
    }

    /// What is computed, in patient mm: the particles of all organs with displacement, speed and body, or the FEM mesh with
    /// displacement and speed, region and volume ratio of its tets.
    ///
    /// # Errors
    /// A GPU that was lost.
    pub fn body_cloud(&self, rest: &RestShape) -> Result<(&'static str, PointCloud<'static>), RehearseError> {
        if let Engine::Tissue(t) = &self.engine {
            return Ok(("tissue", t.cloud()));
        }
        let at = self.engine.positions()?;
        let mut body = vec![0.0; at.len()];
        for (n, b) in self.engine.bodies().iter().enumerate() {
            if let Some(part) = body.get_mut(b.particles.clone()) {
                part.fill(n as f32);
            }
        }
        let velocities = self.engine.velocities()?;
        let speed = velocities.iter().map(|&v| Vec3::from(v).length()).collect();
        let cloud = PointCloud {
            points_mm: super::patient(&at, self.origin),
            arrays: vec![
                VtuArray::Vectors("displacement_mm".into(), displacement(&at, &rest.particles)),
                VtuArray::Scalars("speed_mm_s".into(), speed),
                VtuArray::Scalars("body".into(), body),
            ],
            ..PointCloud::default()
        };
        Ok(("particles", cloud))
    }

    /// The supports in patient mm.
    pub fn support_clouds(&self) -> Vec<PointCloud<'_>> {
        self.supports
            .iter()
            .map(|m| PointCloud {
                points_mm: super::patient(&m.vertices, self.origin),
                triangles: &m.triangles,
                ..PointCloud::default()
            })
            .collect()
    }

    /// Instruments and needles where they are, in patient mm: name, vertices and triangles.
    pub fn instrument_meshes(&self) -> Vec<(String, Vec<[f64; 3]>, Vec<[u32; 3]>)> {
        let tools = self.tools.iter().map(|t| {
            let at = placed(&t.mesh, t.now);
            (t.name.clone(), at)
        });
        tools
            .chain(self.needle_meshes(0.0))
            .map(|(name, mesh)| (name, super::patient(&mesh.vertices, self.origin), mesh.triangles))
            .collect()
    }

    /// Needles by name, no thinner than `least_mm` in radius.
    fn needle_meshes(&self, least_mm: f32) -> Vec<(String, Mesh)> {
        match &self.engine {
            Engine::Tissue(t) => t.shaft_meshes(least_mm),
            _ => Vec::new(),
        }
    }

    /// Where the needles' targets are.
    fn targets(&self) -> Vec<[f32; 3]> {
        let at = match self.trace.steps.last() {
            Some(row) => row.needles.iter().filter_map(|n| n.target_mm).collect::<Vec<_>>(),
            None => self
                .trace
                .needles
                .iter()
                .filter_map(|n| n.target_rest_mm)
                .collect(),
        };
        at.into_iter()
            .map(|p| (DVec3::from(p) - self.origin).as_vec3().to_array())
            .collect()
    }

    /// Positions as they are now, to measure displacements from.
    ///
    /// # Errors
    /// A GPU that was lost.
    pub fn rest_shape(&self) -> Result<RestShape, RehearseError> {
        Ok(RestShape {
            surfaces: self
                .organs
                .iter()
                .map(|o| o.meshes().map(|m| m.mesh.vertices.clone()).collect())
                .collect(),
            particles: self.engine.positions()?.into_owned(),
        })
    }
}

/// Where everything was at the start, world mm.
#[derive(Clone, Debug, Default)]
pub struct RestShape {
    surfaces: Vec<Vec<Vec<[f32; 3]>>>,
    /// None of finite elements, which know their rest shape.
    particles: Vec<[f32; 3]>,
}

/// A grey image cut to the transducer's field of view.
#[derive(Clone, Debug, PartialEq)]
pub struct CroppedImage {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// One byte per pixel, row by row from the face.
    pub grey: Vec<u8>,
    /// Width, mm.
    pub width_mm: f64,
    /// Depth, mm.
    pub depth_mm: f64,
}

impl CroppedImage {
    /// For drawing.
    pub fn borrow(&self) -> GreyImage<'_> {
        GreyImage {
            width: self.width,
            height: self.height,
            grey: &self.grey,
            width_mm: self.width_mm,
            depth_mm: self.depth_mm,
        }
    }

    /// As a picture of its own.
    pub fn picture(&self) -> Picture {
        Picture {
            width: self.width,
            height: self.height,
            pixels: self.grey.iter().flat_map(|&g| [g; 3]).collect(),
        }
    }
}

fn displacement(now: &[[f32; 3]], rest: &[[f32; 3]]) -> Vec<[f32; 3]> {
    now.iter()
        .zip(rest)
        .map(|(&a, &b)| (Vec3::from(a) - Vec3::from(b)).to_array())
        .collect()
}

fn placed(mesh: &Mesh, pose: RigidPose) -> Mesh {
    let turn = |n: &[f32; 3]| (pose.rotation * Vec3::from(*n).as_dvec3()).as_vec3().to_array();
    Mesh {
        vertices: mesh
            .vertices
            .iter()
            .map(|&v| pose.apply(Vec3::from(v).as_dvec3()).as_vec3().to_array())
            .collect(),
        normals: mesh.normals.iter().map(turn).collect(),
        triangles: mesh.triangles.clone(),
    }
}

fn level_name(level: Level, nominal: bool) -> &'static str {
    match level {
        Level::Slice if nominal => "level 0, nominal intensities (no CT)",
        Level::Slice => "level 0, scan intensities",
        Level::Grey => "level 1, grey map and depth gain",
        Level::Rays => "level 2, rays",
        Level::BMode => "level 3, synthetic B-mode",
    }
}
