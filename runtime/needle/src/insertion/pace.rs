//! How long the parts of a step are to be, from how violent those before were.

/// What a part did of what a part may do at most: above 1 it is too violent.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Violence {
    /// Turn of a needle's edge.
    pub turn: f64,
    /// Slip of a node along the needle.
    pub slip: f64,
    /// Change of a tet's deformation gradient.
    pub strain: f64,
}

impl Violence {
    /// That of a part that came to nothing.
    pub fn whole() -> Self {
        Self {
            turn: 0.0,
            slip: 2.0,
            strain: 2.0,
        }
    }

    /// The greatest of all; infinite for what is not a number.
    pub fn most(&self) -> f64 {
        let all = [self.turn, self.slip, self.strain];
        match all.iter().any(|v| v.is_nan()) {
            true => f64::INFINITY,
            false => all.into_iter().fold(0.0, f64::max),
        }
    }

    /// Whether it is a turn alone.
    pub fn is_turn(&self) -> bool {
        self.turn > 1.0 && self.slip <= 1.0 && self.strain <= 1.0
    }
}

/// Memory of the parts before, kept from step to step.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Pace {
    /// Halvings of a step at which the next part begins.
    pub level: u32,
    /// Turn that made the last part tried fail, alone.
    turned: Option<f64>,
    /// Whether parts are braked, until one is calm: what a snap leaves of speed would swing on by the trapezoid rule.
    pub braking: bool,
}

impl Pace {
    /// A part of `halvings` was well: the next may be as much longer as it could have been itself.
    pub fn calm(&mut self, halvings: u32, found: Violence) {
        let most = found.most();
        let longer = match most > 1.0 / 1024.0 {
            true => (1.0 / most).log2().floor().max(0.0) as u32,
            false => 10,
        };
        self.level = halvings.saturating_sub(longer);
        self.turned = None;
        self.braking &= most > CALM;
    }

    /// A part of `halvings` was too violent: the next is as much shorter as its violence asks for, which slip and strain go with. A turn may not.
    pub fn violent(&mut self, halvings: u32, found: Violence, most_halvings: u32) {
        let shorter = match found.is_turn() {
            true => 1,
            false => found.most().min(1024.0).log2().ceil().max(1.0) as u32,
        };
        self.level = (halvings + shorter).min(most_halvings);
        self.turned = found.is_turn().then_some(found.turn);
    }

    /// Whether a needle that fails by its turn turns nearly as far as in a part twice as long: it snaps straight, in any time, and
    /// no shorter part helps.
    pub fn snaps(&self, found: Violence) -> bool {
        found.is_turn() && self.turned.is_some_and(|t| found.turn > SNAP * t)
    }
}

/// Share of the turn in a part twice as long from which a needle snaps.
const SNAP: f64 = 0.75;
/// Violence below which a braked part is calm.
const CALM: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    fn slip(slip: f64) -> Violence {
        Violence {
            slip,
            ..Violence::default()
        }
    }

    #[test]
    fn lengths_follow_violence() {
        let mut pace = Pace::default();
        pace.violent(0, slip(1.7), 4);
        assert_eq!(pace.level, 1);
        pace.violent(1, slip(3.9), 4);
        assert_eq!(pace.level, 3);
        pace.violent(3, slip(100.0), 4);
        assert_eq!(pace.level, 4);
        pace.calm(4, slip(0.6));
        assert_eq!(pace.level, 4);
        pace.calm(4, slip(0.24));
        assert_eq!(pace.level, 2);
        pace.calm(2, slip(0.0));
        assert_eq!(pace.level, 0);
        assert!(
            Violence {
                turn: f64::NAN,
                ..slip(0.1)
            }
            .most()
            .is_infinite()
        );
    }

    #[test]
    fn only_what_a_shorter_part_does_not_lessen_snaps() {
        let turn = |turn| Violence {
            turn,
            ..Violence::default()
        };
        let mut pace = Pace::default();
        assert!(!pace.snaps(turn(6.0)));
        pace.violent(0, turn(6.0), 4);
        assert!((pace.level, pace.snaps(turn(5.5)), pace.snaps(turn(3.1))) == (1, true, false));
        let both = Violence {
            slip: 1.5,
            ..turn(5.5)
        };
        assert!(!pace.snaps(both));
        pace.calm(1, turn(0.9));
        assert!(!pace.snaps(turn(5.5)));
    }
}
