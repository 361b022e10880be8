"""What is looked at: dataset, model, action, trial, variant. A change here reruns everything."""

from __future__ import annotations

from html import escape

import numpy as np
import viser

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.catalog import Catalog
from mild_viz.dashboard.tabs.widgets import Changed, offer, on_person, option, set_content
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout
from mild_viz.settings import VARIANTS, InferSettings, Variant
from mild_viz.trial import Trial


class TrialTab:
    """Dropdowns of which each offers what the ones above it leave."""

    def __init__(self, gui: viser.GuiApi, catalog: Catalog, first: InferSettings, model: str, changed: Changed) -> None:
        self._catalog = catalog
        trial = catalog.dataset(first.dataset).trial(first.split, first.trial)
        self._last = (first.dataset, trial.action)
        self._last_robot = catalog.robot_name
        titles = catalog.robot_titles
        self._robot = gui.add_dropdown(
            "Robot", tuple(titles.values()), initial_value=titles[self._last_robot],
            hint="The robot that answers. Models of two humans drive any; others the one that they were made for.",
        )  # fmt: skip
        checkpoint = catalog.checkpoint(model)
        self._dataset = gui.add_dropdown(
            "Dataset", (first.dataset,), hint="Recordings that are on this machine and that a model fits."
        )
        self._model = gui.add_dropdown(
            "Model", (model,), hint="Trained models (checkpoints) that fit dataset and robot."
        )
        self._action = gui.add_dropdown(
            "Action", catalog.actions(model, first.dataset), initial_value=trial.action,
            hint="Kind of interaction; each has its own hidden Markov model.",
        )  # fmt: skip
        self._trial = gui.add_dropdown(
            "Trial", tuple(catalog.trials(first.dataset, trial.action)), initial_value=f"{trial.split} {trial.index}",
            hint="One recording. The model never saw those of the test set in training.",
        )  # fmt: skip
        self._variant = gui.add_dropdown(
            "Variant", checkpoint.variants, initial_value=first.variant,
            hint="How it was trained and conditioned: v1 to v3.2 as in the paper; v4 is ours, with states of its own.",
        )  # fmt: skip
        self._note = gui.add_html("")
        self._others = gui.add_html("")
        for handle in (self._robot, self._dataset, self._model, self._action, self._trial, self._variant):
            on_person(handle, changed)

    def read(self) -> tuple[InferSettings, Checkpoint, Trial, RobotModel]:
        """What is chosen, after offering what fits it. On a UserError robot and dataset are put back to the last good.

        A robot that no model drives on this dataset brings its own dataset, and a dataset its own robot.
        """
        try:
            robot, dataset = self._robot_and_dataset()
        except UserError:
            self._dataset.value = self._last[0]
            self._robot.value = self._catalog.robot_titles[self._last_robot]
            raise
        new_dataset = (dataset, robot) != (self._last[0], self._last_robot)
        self._last_robot = robot
        models = self._catalog.models(dataset, robot)
        offer(self._model, models, models[0] if new_dataset else None)
        model = option(self._model)
        checkpoint = self._catalog.checkpoint(model)
        offer(self._action, self._catalog.actions(model, dataset))
        action = option(self._action)
        trials = self._catalog.trials(dataset, action)
        offer(self._trial, trials, next(iter(trials)) if (dataset, action) != self._last else None)
        self._last = (dataset, action)
        trial = trials[option(self._trial)]
        offer(self._variant, checkpoint.variants)
        settings = InferSettings(dataset, trial.split, trial.index, option(self._variant))
        return settings, checkpoint, trial, self._catalog.robot(robot)

    def _robot_and_dataset(self) -> tuple[str, str]:
        """The chosen names, each after the other where they do not go together; whichever changed last wins."""
        titles = self._catalog.robot_titles
        title, dataset = option(self._robot), option(self._dataset)
        robot = next(name for name in titles if titles[name] == title)
        if robot != self._last_robot:
            fitting = self._catalog.dataset_for(robot, dataset)
            if fitting is None:
                raise UserError(f"no model here drives {title} on any dataset that is on this machine")
            if fitting != dataset:
                self._dataset.value = dataset = fitting
        else:
            answering = self._catalog.robot_for(dataset, robot)
            if answering is None:
                problems = [str(self._catalog.problem(model, dataset, robot)) for model in self._catalog.model_paths]
                raise UserError(f"no model fits dataset '{dataset}': {'; '.join(problems) or 'there is none'}")
            if answering != robot:
                robot = answering
                self._robot.value = titles[robot]
        return robot, dataset

    def offer_datasets(self) -> None:
        """List the datasets that can be used, and how to get the others. Reads them: call it when the page stands."""
        usable, others = self._catalog.offers()
        offer(self._dataset, usable if self._last[0] in usable else (self._last[0], *usable))
        if others:
            lines = "<br>".join(f"{escape(name)}: {escape(reason)}" for name, reason in others.items())
            set_content(self._others, f'<div class="mv-note"><b>Datasets not offered</b><br>{lines}</div>')

    def show(self, rollout: Rollout) -> None:
        """Say what the variant is and, where it uses the posterior's covariance, whether that can matter here."""
        inference = rollout.inference
        variant = VARIANTS[inference.variant]
        text = escape(f"{variant.name}: {variant.summary}.")
        if variant.own_models:
            text += " Not of the paper. It has its own states and contact states; the first of its models is drawn."
        if variant.posterior_covariance:
            posterior, states = (
                float(np.sqrt(np.nanmean(np.diagonal(covariance, axis1=1, axis2=2))))
                for covariance in (inference.human_latent_covariance, inference.human_state_covariances)
            )
            text += f" The posterior's spread is {posterior:.2g}, that of the states {states:.2g}."
            if posterior < 0.1 * states:
                text += (
                    " The covariance itself changes almost nothing here; "
                    f"differences to {_without_covariance(variant)} come from another trained decoder."
                )
            else:
                text += " So the covariance matters here."
        set_content(self._note, f'<div class="mv-note">{text}</div>')


def _without_covariance(variant: Variant) -> str:
    """The variant that differs in the covariance alone."""
    return next(
        other.name
        for other in VARIANTS.values()
        if other.conditional_training == variant.conditional_training and not other.posterior_covariance
    )
