//! Turns a patient's segmented CT into a model package: the recipe, the stage order, progress, report.
