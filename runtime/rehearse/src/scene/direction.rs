use super::names::nearest;
use glam::DVec3;
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// A direction in the patient: one of the six names, or a vector in patient RAS (x right, y anterior, z superior) of any
/// length above 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Direction(DVec3);

const NAMES: [(&str, DVec3); 6] = [
    ("right", DVec3::X),
    ("left", DVec3::NEG_X),
    ("anterior", DVec3::Y),
    ("posterior", DVec3::NEG_Y),
    ("superior", DVec3::Z),
    ("inferior", DVec3::NEG_Z),
];

impl Direction {
    /// To the patient's front.
    pub const ANTERIOR: Self = Self(DVec3::Y);
    /// To the patient's back.
    pub const POSTERIOR: Self = Self(DVec3::NEG_Y);

    /// From a vector; none where it has no length.
    pub fn from_vector(v: DVec3) -> Option<Self> {
        v.try_normalize().map(Self)
    }

    /// The direction with this name.
    pub fn named(name: &str) -> Option<Self> {
        NAMES.iter().find(|(n, _)| *n == name).map(|&(_, v)| Self(v))
    }

    /// Unit vector, patient RAS.
    pub fn unit(self) -> DVec3 {
        self.0
    }
}

impl fmt::Display for Direction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match NAMES.iter().find(|(_, v)| *v == self.0) {
            Some((name, _)) => f.write_str(name),
            None => write!(f, "({:.3}, {:.3}, {:.3})", self.0.x, self.0.y, self.0.z),
        }
    }
}

impl Serialize for Direction {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match NAMES.iter().find(|(_, v)| *v == self.0) {
            Some((name, _)) => s.serialize_str(name),
            None => self.0.to_array().serialize(s),
        }
    }
}

impl<'de> Deserialize<'de> for Direction {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = Direction;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("a patient direction (right, left, anterior, posterior, superior, inferior) or three numbers")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Direction, E> {
                Direction::named(text).ok_or_else(|| {
                    let known = NAMES.map(|(n, _)| n);
                    let hint = nearest(text, &known)
                        .map_or_else(String::new, |k| format!("; did you mean \"{k}\"?"));
                    E::custom(format!(
                        "unknown direction \"{text}\", expected {}{hint}",
                        known.join(", ")
                    ))
                })
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Direction, A::Error> {
                let mut v = Vec::new();
                while let Some(x) = seq.next_element::<f64>()? {
                    v.push(x);
                }
                <[f64; 3]>::try_from(v.as_slice())
                    .ok()
                    .filter(|v| v.iter().all(|x| x.is_finite() && x.abs() < 1e9))
                    .and_then(|v| Direction::from_vector(DVec3::from_array(v)))
                    .ok_or_else(|| {
                        A::Error::custom(format!("direction {v:?}, expected three numbers, not all 0"))
                    })
            }
        }
        d.deserialize_any(Either)
    }
}
