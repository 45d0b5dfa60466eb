"""Ablation tables: trained variants that show what each choice of the network is worth."""
