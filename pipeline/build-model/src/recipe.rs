use crate::UsageError;
use crate::args::BuildArgs;
use anyhow::Context;
use palpate_particles::ParticleParams;
use palpate_skinning::SkinParams;
use palpate_surface::SurfaceParams;
use palpate_tetmesh::{EmbeddingParams, FemParams};
use palpate_volume::{
    AnatomySelection, ComponentChoice, LabelTable, PRESET_NAMES, RegionSelection, Selection, VolumeParams,
    preset,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Everything that decides what a build makes of a scan. Reads from and writes to one TOML file, and is stored in
/// the package.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Recipe {
    /// Which labels become which body, and which component is built.
    pub selection: AnatomySelection,
    /// Names of labels, for the package's label table.
    pub label_names: Vec<LabelName>,
    /// Repair and fields.
    pub volume: VolumeParams,
    /// Collision surfaces.
    pub surface: SurfaceParams,
    /// Particles and clusters.
    pub particles: ParticleParams,
    /// Cluster frames per skinned point.
    pub skinning: SkinParams,
    /// FEM mesh.
    pub fem: FemParams,
    /// Embedding mesh.
    pub embedding: EmbeddingParams,
    /// Material constants that the package carries.
    pub tissue: TissueParams,
}

impl Default for Recipe {
    /// No organ yet: flags, a preset or a recipe file name it.
    fn default() -> Self {
        let organ = RegionSelection {
            name: String::new(),
            labels: Vec::new(),
        };
        Self {
            selection: AnatomySelection {
                organ,
                structures: Vec::new(),
                supports: Vec::new(),
                component: ComponentChoice::default(),
            },
            label_names: Vec::new(),
            volume: VolumeParams::default(),
            surface: SurfaceParams::default(),
            particles: ParticleParams::default(),
            skinning: SkinParams::default(),
            fem: FemParams::default(),
            embedding: EmbeddingParams::default(),
            tissue: TissueParams::default(),
        }
    }
}

/// The name that a table gives to a label.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelName {
    /// Value in the label map.
    pub label: i64,
    /// Its name.
    pub name: String,
}

/// Material constants.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TissueParams {
    /// Tissue density in g/mm³; 1.05e-3 is the paper's Table 1.
    pub density_g_per_mm3: f64,
}

impl Default for TissueParams {
    fn default() -> Self {
        Self {
            density_g_per_mm3: 1.05e-3,
        }
    }
}

impl Recipe {
    /// The recipe file, if one is named, with the flags on top.
    ///
    /// # Errors
    /// [`UsageError`] for flags that make no sense; a fault for files that cannot be read or parsed.
    pub fn from_args(args: &BuildArgs) -> anyhow::Result<Self> {
        let mut recipe = match &args.recipe {
            Some(path) => Self::read(path)?,
            None => Self::default(),
        };
        recipe.select(args)?;
        let positive = |name: &str, v: Option<f64>| match v {
            Some(v) if !(v.is_finite() && v > 0.0) => {
                Err(UsageError(format!("{name} {v}: expected a length in mm above 0")))
            }
            v => Ok(v),
        };
        let count = |name: &str, v: Option<usize>, least: usize| match v {
            Some(v) if v < least => Err(UsageError(format!("{name} {v}: expected at least {least}"))),
            v => Ok(v),
        };
        if let Some(n) = count("--faces", args.faces, 100)? {
            recipe.surface.target_faces = n;
            // Asked for by number: no more than that, however large the body.
            recipe.surface.largest_mean_face_mm2 = 0.0;
        }
        if let Some(r) = positive("--radius", args.radius)? {
            recipe.particles.radius_mm = r;
        }
        if let Some(n) = count("--fem-tets", args.fem_tets, 100)? {
            recipe.fem.target_tets = n;
            recipe.fem.edge_mm = None;
        }
        if let Some(h) = positive("--fem-edge", args.fem_edge)? {
            recipe.fem.edge_mm = Some(h);
        }
        if let Some(n) = count("--embedding-tets", args.embedding_tets, 50)? {
            recipe.embedding.target_tets = n;
            recipe.embedding.edge_mm = None;
        }
        recipe.fem.graded |= args.fem_graded;
        recipe.fem.optimise &= !args.no_optimise;
        recipe.volume.keep_topology |= args.keep_topology;
        Ok(recipe)
    }

    /// Reads a recipe file.
    ///
    /// # Errors
    /// A file that cannot be read, or is not a recipe; the message names line and key.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the recipe: {}", path.display()))?;
        toml::from_str(&text).with_context(|| format!("not a recipe: {}", path.display()))
    }

    /// The recipe as TOML text.
    ///
    /// # Errors
    /// Values that TOML cannot hold.
    pub fn to_toml(&self) -> anyhow::Result<String> {
        toml::to_string(self).context("the recipe cannot be written as TOML")
    }

    fn select(&mut self, args: &BuildArgs) -> anyhow::Result<()> {
        let usage = |e: &dyn std::error::Error| anyhow::Error::from(UsageError(e.to_string()));
        let mut table = LabelTable {
            entries: self
                .label_names
                .iter()
                .map(|l| (l.label, l.name.clone()))
                .collect(),
        };
        if let Some(name) = &args.preset {
            let p = preset(name).ok_or_else(|| {
                UsageError(format!(
                    "no preset is named {name:?}; there are {}",
                    PRESET_NAMES.join(", ")
                ))
            })?;
            table = p.table;
            match (&args.organ, p.organ) {
                (None, Some(organ)) => {
                    self.selection.organ = region(organ);
                    self.selection.structures = p.structures.into_iter().map(region).collect();
                }
                (None, None) if self.selection.organ.labels.is_empty() => {
                    return Err(UsageError(format!(
                        "the preset {name} names many organs: choose one with --organ, for example --organ {}",
                        table.entries.get(1).map_or("NAME", |e| e.1.as_str())
                    ))
                    .into());
                }
                _ => {}
            }
        } else if let Some(path) = &args.labels {
            table = LabelTable::from_itksnap(path)?;
        }
        if let Some(text) = &args.organ {
            self.selection.organ = region(Selection::parse(text, &table).map_err(|e| usage(&e))?);
        }
        let parse = |list: &[String]| -> anyhow::Result<Vec<RegionSelection>> {
            list.iter()
                .map(|t| Ok(region(Selection::parse(t, &table).map_err(|e| usage(&e))?)))
                .collect()
        };
        if !args.structure.is_empty() {
            self.selection.structures = parse(&args.structure)?;
        }
        if !args.support.is_empty() {
            self.selection.supports = parse(&args.support)?;
        }
        if let Some(which) = &args.component {
            self.selection.component = component(which)?;
        }
        let s = &self.selection;
        let wanted: Vec<i64> = std::iter::once(&s.organ)
            .chain(&s.structures)
            .chain(&s.supports)
            .flat_map(|r| r.labels.iter().copied())
            .collect();
        self.label_names = wanted
            .iter()
            .filter_map(|&label| {
                Some(LabelName {
                    label,
                    name: table.name(label)?.to_string(),
                })
            })
            .collect();
        Ok(())
    }

    /// Refuses a selection without an organ, names used twice and labels used twice.
    ///
    /// # Errors
    /// [`UsageError`] that names the clash.
    pub fn check_selection(&self) -> Result<(), UsageError> {
        let s = &self.selection;
        if s.organ.labels.is_empty() {
            return Err(UsageError(
                "no organ: give --organ NAME=L[,L…], or a --preset that has one, or a --recipe".into(),
            ));
        }
        let bodies: Vec<&RegionSelection> = std::iter::once(&s.organ)
            .chain(&s.structures)
            .chain(&s.supports)
            .collect();
        for (n, a) in bodies.iter().enumerate() {
            if a.labels.is_empty() {
                return Err(UsageError(format!("the body {} has no labels", a.name)));
            }
            for b in &bodies[..n] {
                if a.name == b.name {
                    return Err(UsageError(format!(
                        "two bodies are named {}; give each its own name",
                        a.name
                    )));
                }
                if let Some(l) = a.labels.iter().find(|l| b.labels.contains(l)) {
                    return Err(UsageError(format!(
                        "label {l} is given to both {} and {}; a voxel belongs to one body",
                        b.name, a.name
                    )));
                }
            }
        }
        Ok(())
    }
}

fn region(s: Selection) -> RegionSelection {
    RegionSelection {
        name: s.name,
        labels: s.labels,
    }
}

fn component(text: &str) -> Result<ComponentChoice, UsageError> {
    match text {
        "largest" => Ok(ComponentChoice::Largest),
        "left" => Ok(ComponentChoice::Left),
        "right" => Ok(ComponentChoice::Right),
        n => match n.parse::<usize>() {
            Ok(n) if n > 0 => Ok(ComponentChoice::Index(n)),
            _ => Err(UsageError(format!(
                "--component {text}: expected largest, left, right or a number from 1"
            ))),
        },
    }
}
